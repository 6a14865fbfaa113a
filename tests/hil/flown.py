"""One case flown on one payload: its stand made, its outcome taken, written and judged."""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol

from links.loopback import LoopbackLink
from links.namespace import NamespaceLink
from links.proxy import ProxyLink

from ground_station.map import store
from ground_station.replay.cases.case import LOOPBACK, NAMESPACE, Case
from ground_station.replay.cases.judge import Judged, judged
from ground_station.replay.cases.outcome import Outcome, write_outcome
from ground_station.replay.cases.source import check_case
from ground_station.replay.cases.taken import outcome_of
from ground_station.replay.replay import replay, settings_for
from ground_station.replay.rig import Rig, Running
from pi_firmware.wire.errors import BlimpError

AGAIN = "again"
"""A case's second run, below its folder."""
_LOG = "firmware.log"
_START_S = 240.0
"""From a firmware's start to its first frame, on a busy machine or an emulated one."""


class Payload(Protocol):
    """What `payloads/` makes: one payload for a whole suite, a context manager."""

    name: str
    link_host: str
    link_port: int

    def describe(self) -> str: ...

    def recording(self, path: Path) -> Path: ...

    def stand(self, settings: tuple[str, ...], link: Any) -> Rig: ...


Link = LoopbackLink | ProxyLink | NamespaceLink


def fly(case: Case, payload: Payload, folder: Path) -> Judged:
    """Flies, writes the outcome to `folder`, judges; errors and skips are told in what it gives."""
    began_s = time.monotonic()
    if why := _unfit(case, payload):
        return Judged(case.name, case.title, payload.name, skipped=why)
    try:
        outcome = _flown(case, payload, folder)
        again = None
        if case.limits(payload.name).identical:
            again = _flown(case, payload, folder / AGAIN)
        seconds = time.monotonic() - began_s
        return judged(outcome, case, payload.name, again=again, seconds=seconds)
    except BlimpError as error:
        seconds = time.monotonic() - began_s
        return Judged(case.name, case.title, payload.name, seconds=seconds, error=str(error))


def _unfit(case: Case, payload: Payload) -> str:
    """Why the case is not flown here, in words; "" when it is."""
    if payload.name not in case.payload.kinds:
        return f"the case is for {', '.join(case.payload.kinds)}"
    if case.link.kind == NAMESPACE:
        if payload.name != "process":
            return "a namespace holds the payload 'process' only"
        return NamespaceLink(case.link).lacks()
    return ""


def _flown(case: Case, payload: Payload, folder: Path) -> Outcome:
    source = check_case(case)
    flown = case.flown(payload.name)
    recording = payload.recording(case.recording_path)
    settings = settings_for(
        case.preset,
        recording,
        rate_hz=flown.rate_hz,
        init=case.first_pose,
        start_s=flown.start_s,
        duration_s=flown.duration_s,
        stepped=case.stepped,
        payload=tuple(flown.settings),
    )
    map_ = store.load(case.map_path)
    folder.mkdir(parents=True, exist_ok=True)
    began_s = time.monotonic()
    with contextlib.ExitStack() as stack:
        link = _link(case, payload, stack)
        result = replay(map_, settings, _stand(payload, tuple(flown.settings), link, folder))
        outcome = outcome_of(
            result,
            map_,
            title=case.title,
            case=case.name,
            payload=payload.name,
            link=link.kind,
            seconds=time.monotonic() - began_s,
            outages=link.outages(),
            link_counts=link.counts(),
            notes=[payload.describe(), f"injected: {link.injected()}", *source.notes],
        )
    write_outcome(folder, outcome)
    return outcome


def _link(case: Case, payload: Payload, stack: contextlib.ExitStack) -> Link:
    if case.link.kind == LOOPBACK:
        return LoopbackLink()
    if case.link.kind == NAMESPACE:
        return stack.enter_context(NamespaceLink(case.link))
    return ProxyLink(case.link, payload.link_host, payload.link_port)


def _stand(payload: Payload, settings: tuple[str, ...], link: Link, folder: Path) -> Rig:
    made = link.stand() if isinstance(link, NamespaceLink) else payload.stand(settings, link)
    flying = _logged(made.payload, folder / _LOG)
    return dataclasses.replace(made, payload=flying, start_timeout_s=_START_S)


def _logged(fly: Callable[..., Any], log: Path) -> Callable[..., Any]:
    """The same payload, whose words are kept beside the outcome, however the flight ends."""

    @contextlib.contextmanager
    def flying(config: dict[str, Any], folder: Path) -> Iterator[Running]:
        log.unlink(missing_ok=True)
        try:
            with fly(config, folder) as running:
                yield running
        finally:
            with contextlib.suppress(OSError):
                shutil.copyfile(folder / _LOG, log)

    return flying
