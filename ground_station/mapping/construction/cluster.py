"""A Dask cluster as workers: the user's own, or a few processes on this machine.

A cluster runs what it is sent, as the user who started it: it belongs to a network whose members
may all do that, or behind `tls://`, whose certificates Dask's own configuration names. Processes on
this machine speak TLS with certificates that are made for them and forgotten.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import functools
import logging
import signal
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from multiprocessing import resource_tracker
from typing import Any, TypeVar

import cv2
import numpy as np

from ground_station import __version__
from ground_station.errors import MapError
from ground_station.mapping.construction.images import extractor_of
from ground_station.mapping.construction.workers import in_order, under_way
from ground_station.mapping.settings import MappingSettings
from pi_firmware.wire.errors import BlimpError

try:
    import distributed
except ImportError:
    raise MapError(
        "--dask needs the package dask[distributed], which `make setup` installs"
    ) from None

Out = TypeVar("Out")

_CONNECT_S, _WORKERS_S = 10, 60
_LOOK_S = 5.0
"""Nobody waits longer for a result without looking whether there is anyone who could give it."""
_ALONE_S = 60.0
"""A cluster without workers is given so long to get one, as when they are all restarted."""
_TRIES = 4
_PAIRS = 16
"""In one call: what goes with a call is then little beside the work in it."""
_LARGE_BYTES = 65_536
"""An array larger than this, such as a picture, goes to a worker by itself: Dask's scheduler keeps
the arguments of every call."""
CANCELLED = (asyncio.CancelledError, concurrent.futures.CancelledError)

Versions = dict[str, str]


@functools.cache
def versions(settings: MappingSettings) -> Versions:
    """What must be the same wherever a part of the map is made."""
    return {
        "blimp": __version__,
        "OpenCV": cv2.__version__,
        settings.features: extractor_of(settings).sha256[:16],
    }


def _difference(theirs: Versions, ours: Versions) -> str | None:
    for name, mine in ours.items():
        if theirs.get(name) != mine:
            return f"has {name} {theirs.get(name, 'missing')}, this machine {mine}"
    return None


def checked(
    ours: Versions, settings: MappingSettings, function: Callable[..., Out], *args: Any
) -> Out:
    """Calls a function in a worker, which may have come when the others had been looked at."""
    if difference := _difference(versions(settings), ours):
        raise MapError(f"a worker {difference}; a map is made of one")
    return function(*args)


@dataclass
class _Shared:
    """A value that is sent to the cluster when the first call needs it, and then stays there."""

    get: Callable[[], Any]
    future: Any = None


@dataclass
class _Call:
    """A call that was sent, and what is needed to send it again."""

    function: Callable[..., Any]
    args: Sequence[Any]
    future: Any = None
    sent: int = field(default=0)


class Cluster:
    """The workers of a Dask cluster, by a client of it."""

    batch = _PAIRS

    def __init__(
        self, client: Any, name: str, settings: MappingSettings, here: bool = False
    ) -> None:
        self.here = here
        self._client, self._place, self._settings = client, name, settings
        self._ours = versions(settings)
        threads = client.nthreads()
        self._count = max(1, sum(threads.values()))
        self.name = f"{name}, {len(threads)} workers"

    @contextmanager
    def shared(self, values: Sequence[Any]) -> Iterator[Sequence[Any]]:
        """Values that go to the cluster once, each when the first call needs it."""
        handles = [_Shared(functools.partial(values.__getitem__, k)) for k in range(len(values))]
        try:
            yield handles
        finally:
            for handle in handles:
                handle.future = None  # the cluster forgets what no client holds

    def map(self, function: Callable[..., Out], items: Iterable[Sequence[Any]]) -> Iterator[Out]:
        """As `Workers.map`. A call is sent again when its worker dies; raises `MapError` when the
        cluster is gone or kills its workers."""

        def send(item: Sequence[Any]) -> _Call:
            call = _Call(function, [_apart(arg) for arg in item])
            self._reached(self._send, call)
            return call

        yield from in_order(
            items,
            send,
            lambda call: self._reached(self._receive, call),
            under_way(self._count),
        )

    def _reached(self, step: Callable[[_Call], Out], call: _Call) -> Out:
        """One step of a call, with what goes wrong beyond this machine in one line."""
        try:
            return step(call)
        except BlimpError:
            raise
        except distributed.KilledWorker:
            raise MapError(
                f"{self._place}: one task ended every worker that tried it; they may have too "
                "little memory"
            ) from None
        except Exception as error:
            if self._client.status != "running" or isinstance(error, OSError):
                raise MapError(f"{self._place}: the cluster is gone ({_line(error)})") from None
            if isinstance(error, ImportError | AttributeError):
                raise MapError(
                    f"{self._place}: a worker has another program: {_line(error)}"
                ) from None
            raise

    def _send(self, call: _Call) -> None:
        args = [self._sent(arg) if isinstance(arg, _Shared) else arg for arg in call.args]
        call.sent += 1
        call.future = self._client.submit(
            checked, self._ours, self._settings, call.function, *args, pure=False
        )

    def _sent(self, value: _Shared) -> Any:
        # What was shared goes with the worker that had it: Dask makes again only what it has made.
        if value.future is None or value.future.status != "finished":
            (value.future,) = self._client.scatter([value.get()], hash=False)
        return value.future

    def _receive(self, call: _Call) -> Any:
        heard_s = time.monotonic()
        while True:
            try:
                return call.future.result(timeout=_LOOK_S)
            except CANCELLED as error:
                self._again(call, _line(error))
            except TimeoutError:
                if any(future.status == "lost" for future in _futures(call)):
                    self._again(call, "what was sent to it is lost")
                if self._client.nthreads():
                    heard_s = time.monotonic()
                elif time.monotonic() - heard_s > _ALONE_S:
                    raise MapError(
                        f"{self._place}: has had no worker for {_ALONE_S:.0f} s"
                    ) from None

    def _again(self, call: _Call, reason: str) -> None:
        # Where the network stutters, Dask connects again by itself, or gives up.
        end_s = time.monotonic() + 2 * _CONNECT_S
        while self._client.status == "connecting" and time.monotonic() < end_s:
            time.sleep(0.1)
        if self._client.status != "running" or call.sent >= _TRIES:
            raise MapError(f"{self._place}: the cluster is gone ({reason})")
        self._send(call)


def _apart(arg: Any) -> Any:
    """A large array as a value of one call's own, which the cluster forgets with the call."""
    if isinstance(arg, np.ndarray) and arg.nbytes > _LARGE_BYTES:
        return _Shared(lambda: arg)
    return arg


def _futures(call: _Call) -> list[Any]:
    shared = [arg.future for arg in call.args if isinstance(arg, _Shared)]
    return [future for future in shared if future is not None]


@contextmanager
def connected(where: str | int, settings: MappingSettings) -> Iterator[Cluster]:
    """The workers of `client_of`, until the block ends."""
    with client_of(where, settings) as client:
        yield Cluster(client, _place(where), settings, here=not isinstance(where, str))


def _place(where: str | int) -> str:
    return where if isinstance(where, str) else "Dask on this machine"


@contextmanager
def client_of(where: str | int, settings: MappingSettings) -> Iterator[Any]:
    """A client of the cluster at an address, or of so many processes on this machine.

    Raises `MapError` where nobody answers, there is no worker, or one of them differs.
    """
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what matters is said in one line
    with ExitStack() as held:
        place = _place(where)
        try:
            client = held.enter_context(_client(where, held))
        except (OSError, TimeoutError, TypeError, ValueError, RuntimeError) as error:
            raise MapError(f"{place}: no Dask scheduler answers ({_line(error)})") from None
        try:
            client.wait_for_workers(1, timeout=_WORKERS_S)
        except TimeoutError:
            raise MapError(f"{place}: the scheduler has no workers") from None
        _check_workers(client, place, settings)
        yield client


def _client(where: str | int, held: ExitStack) -> Any:
    if isinstance(where, str):
        return distributed.Client(where, timeout=_CONNECT_S, set_as_default=False)
    folder = held.enter_context(tempfile.TemporaryDirectory(prefix="blimp-dask-"))
    with _uninterrupted():
        cluster = distributed.LocalCluster(
            n_workers=where,
            threads_per_worker=1,
            host="127.0.0.1",
            protocol="tls://",
            security=True,  # certificates of its own: no other user of this machine sends tasks
            dashboard_address="127.0.0.1:0",
            worker_dashboard_address="127.0.0.1:0",
            local_directory=folder,
            silence_logs=logging.CRITICAL,
        )
    held.enter_context(cluster)
    return distributed.Client(cluster, timeout=_CONNECT_S, set_as_default=False)


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Processes and threads that begin meanwhile never see Ctrl-C: it is this one that ends them.

    Else each would print where it was interrupted.
    """
    resource_tracker.ensure_running()  # which unblocks what is blocked when it begins later
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _check_workers(client: Any, place: str, settings: MappingSettings) -> None:
    ours = versions(settings)
    try:
        answers = client.run(versions, settings, on_error="return")
    except Exception as error:
        raise MapError(f"{place}: a worker has another program: {_line(error)}") from None
    for address, theirs in answers.items():
        if isinstance(theirs, BaseException):
            raise MapError(f"{place}: the worker {address} lacks something: {_line(theirs)}")
        if difference := _difference(theirs, ours):
            raise MapError(f"{place}: the worker {address} {difference}; a map is made of one")


def _line(error: BaseException) -> str:
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 200 else text[:199] + "…"
