"""The service's local bus: a Zenoh router on a unix socket that only its own user can reach.

The parent holds the router, every process is a client of it: one that dies and comes back is heard
again without anyone else noticing. Pictures do not cross it; they lie in `pictures`.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import resource
import time
from collections.abc import Callable, Mapping
from io import FileIO
from pathlib import Path
from typing import Any

from ground_station.errors import GroundStationError
from ground_station.service import bus_messages
from ground_station.service.bus_messages import Message, N, ProcessMessage
from ground_station.stream.newest import Newest
from pi_firmware.wire.errors import BlimpError

_SOCKET = "bus"
_OPEN_LIMIT_S = 10.0
_LEASE_S = 3600.0
"""How long a silent process keeps its place: one that dies closes its socket, and one that was only
stopped, as by a computer that slept, is to hear at once what comes when it wakes."""

Do = Callable[[Mapping[str, Any]], Mapping[str, Any]]


def _open(mode: str, folder: Path) -> Any:
    """A session of Zenoh; raises `GroundStationError` with one line."""
    import zenoh

    endpoint = f"unixsock-stream/{folder / _SOCKET}"
    config = zenoh.Config()
    for name, value in {
        "mode": mode,
        "listen/endpoints": [endpoint] if mode == "router" else [],
        "connect/endpoints": [] if mode == "router" else [endpoint],
        "connect/timeout_ms": int(_OPEN_LIMIT_S * 1000),
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": int(_LEASE_S * 1000),
    }.items():
        config.insert_json5(name, json.dumps(value))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise GroundStationError(f"{folder}: {str(error).splitlines()[0][:160]}") from None


class Router:
    """The bus itself, in the parent; raises `GroundStationError` where the folder has no room."""

    def __init__(self, folder: Path) -> None:
        self._session = _open("router", folder)

    def close(self) -> None:
        """Ends it; clients wait for the next one."""
        self._session.close()


class Bus:
    """A process's place on the bus; a context manager.

    Handlers run on a thread of the session and must return soon. `dropped` counts what was no
    message. A process that is too slow to hear a message loses it, or with `lossless` is waited
    for. Raises `GroundStationError` when there is no bus in the folder.
    """

    def __init__(self, folder: Path, process: str, *, lossless: bool = False) -> None:
        import zenoh

        self.process = process
        control = zenoh.CongestionControl
        self._congestion = control.BLOCK if lossless else control.DROP
        self.dropped = 0
        self._started_s = time.monotonic()
        self._beat_s, self._cpu_s = self._started_s, _cpu_s()
        self._session = _open("client", folder)
        self._declared: list[Any] = []
        # Kept open: a process that has no descriptor left lives, and says so.
        self._statm = FileIO("/proc/self/statm")

    def __enter__(self) -> Bus:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leaves the bus."""
        self._session.close()
        self._statm.close()

    def publish(self, kind: str, payload_id: str, message: Message) -> None:
        """Tells all processes."""
        self._session.put(
            f"station/{kind}/{payload_id}",
            bus_messages.encode(message),
            congestion_control=self._congestion,
        )

    def subscribe(
        self, kind: str, of: type[N], take: Callable[[str, N], None], payload_id: str = "*"
    ) -> None:
        """Calls `take` with the payload's id and each message of a kind."""

        def received(sample: Any) -> None:
            try:
                message = bus_messages.decode(of, sample.payload.to_bytes())
            except bus_messages.MessageError:
                self.dropped += 1
                return
            take(str(sample.key_expr).rpartition("/")[2], message)

        key = f"station/{kind}/{payload_id}"
        self._declared.append(self._session.declare_subscriber(key, received))

    def newest(
        self,
        kind: str,
        of: type[N],
        payload_id: str = "*",
        most: int = 1,
        oldest_s: float = math.inf,
    ) -> Newest[N]:
        """Where up to `most` messages of a kind wait; see `Newest` for what is let go of."""
        newest: Newest[N] = Newest(most, oldest_s)
        self.subscribe(kind, of, lambda _, message: newest.put(message), payload_id)
        return newest

    def serve(self, name: str, do: Do) -> None:
        """Answers questions at a name; a `BlimpError` becomes a refusal with its text."""
        key = f"station/do/{name}"

        def asked(query: Any) -> None:
            try:
                request = json.loads(query.payload.to_bytes()) if query.payload else None
                if not isinstance(request, dict):
                    raise bus_messages.MessageError("the question is no JSON object")
                answer = {"done": True, "reason": "", **do(request)}
            except BlimpError as error:
                answer = {"done": False, "reason": str(error)}
            except Exception as error:  # a question must not end a process
                answer = {"done": False, "reason": f"{type(error).__name__}: {error}"}
            with contextlib.suppress(Exception):  # whoever asked may be gone
                query.reply(key, json.dumps(answer).encode())

        self._declared.append(self._session.declare_queryable(key, asked))

    def query(
        self, name: str, request: Mapping[str, Any], timeout_s: float = 5.0
    ) -> Mapping[str, Any]:
        """Asks at a name; without an answer in time it is a refusal that says so."""
        body = json.dumps(request).encode()
        key = f"station/do/{name}"
        with contextlib.suppress(Exception):
            for reply in self._session.get(key, payload=body, timeout=timeout_s):
                if reply.ok is not None:
                    answer = json.loads(reply.ok.payload.to_bytes())
                    if isinstance(answer, dict):
                        return {"done": False, "reason": "", **answer}
        return {"done": False, "reason": f"the service's {name} did not answer"}

    def heartbeat(self) -> None:
        """Says that this process lives, at most once a second; to be called from its main loop."""
        now_s = time.monotonic()
        span_s = now_s - self._beat_s
        if span_s < 1.0 and self._beat_s != self._started_s:
            return
        used_s = _cpu_s()
        share = (used_s - self._cpu_s) / span_s if span_s > 0 else 0.0
        self._beat_s, self._cpu_s = now_s, used_s
        message = ProcessMessage(
            name=self.process,
            pid=os.getpid(),
            memory_MB=self._resident_MB(),
            cpu=share,
            uptime_s=now_s - self._started_s,
        )
        self.publish(bus_messages.PROCESS, bus_messages.STATION, message)

    def _resident_MB(self) -> float:
        self._statm.seek(0)
        return int(self._statm.read().split()[1]) * resource.getpagesize() / 1e6


def _cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime
