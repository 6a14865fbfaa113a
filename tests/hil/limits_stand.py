"""Where a trial takes place: its program, the link before it, and what holds it back."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import IO, Any

from limits_axes import Conditions
from limits_trial import TRACKING_S, Outcome, Trial

from ground_station.errors import GroundStationError

TESTS = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(TESTS / "faults")]

from impaired_link import ImpairedLink, Impairment  # noqa: E402
from limits_throttle import throttled  # noqa: E402
from payload_process import free_port  # noqa: E402

_START_S = 120.0
"""Loading, and a payload's start, on a slow machine."""
_SLOWEST = 8.0
"""A flight that takes so many times as long as it should is ended: TRACKING is 0 then."""
_END_S = 20.0


class TrialError(GroundStationError):
    """A trial's program failed in a way that says nothing of the system's limits."""


@dataclass(frozen=True)
class Flight:
    """What all trials fly."""

    recording: Path
    map: Path
    duration_s: float
    """Of each trial; of the service: how long it is looked at."""


@dataclass(frozen=True)
class Measured:
    """One trial's share, with what may explain it; `others_cores` used the machine beside it."""

    share: float
    outcome: dict[str, Any] = field(default_factory=dict)
    link: dict[str, int] = field(default_factory=dict)
    held_by: str = ""
    others_cores: float | None = None
    took_s: float = 0.0
    why: str = ""
    """In words, when it could not be flown to its end."""


def measure(flight: Flight, under: Conditions, seed: int) -> Measured:
    """Flies one trial. Raises `TrialError` for what is no limit but a failure of the trial."""
    began_s, machine_s, own_s = time.monotonic(), _machine_s(), _own_s()
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="blimp-limits-")))
        link: ImpairedLink | None = None
        video_port = link_port = 0
        if under.impairment:
            video_port = free_port(socket.SOCK_DGRAM)
            link = ImpairedLink(video_port, Impairment(**under.impairment), seed=seed)
            stack.enter_context(link)
            link_port = link.port
        trial = Trial(
            recording=str(flight.recording),
            map=str(flight.map),
            rate_hz=under.rate_hz,
            duration_s=flight.duration_s,
            payload=under.payload,
            video_port=video_port,
            link_port=link_port,
            payloads=under.payloads,
        )
        held: list[str] = []
        outcome, why = _run(trial, under, folder, held)
        counts = asdict(link.counts) if link else {}
    took_s = time.monotonic() - began_s
    others = (_machine_s() - machine_s - (_own_s() - own_s)) / took_s
    return Measured(
        outcome.share if outcome else 0.0,
        asdict(outcome) if outcome else {},
        counts,
        ", ".join(held),
        max(0.0, others),
        took_s,
        why,
    )


def _run(
    trial: Trial, under: Conditions, folder: Path, held: list[str]
) -> tuple[Outcome | None, str]:
    path = folder / "trial.json"
    path.write_text(json.dumps(asdict(trial)))
    limit_s = _START_S + _SLOWEST * trial.duration_s + (TRACKING_S if trial.payloads else 0.0)
    with (
        (folder / "errors.txt").open("w+") as errors,
        contextlib.ExitStack() as throttles,
        # In a session of its own: a Ctrl-C is for whoever measures, who then ends the trial.
        subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("limits_trial.py")), str(path)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            start_new_session=True,
        ) as program,
    ):
        try:
            outcome = None
            for line in _lines(program, limit_s):
                if line["kind"] == "flying":
                    payload = int(line["payload"])
                    for pid, cores, spared in (
                        (program.pid, under.ground_cores, (payload,)),
                        (payload, under.payload_cores, ()),
                    ):
                        if cores:
                            held.append(throttles.enter_context(throttled(pid, cores, spared)))
                elif line["kind"] == "landed":
                    throttles.close()
                elif line["kind"] == "result":
                    outcome = Outcome(**line["outcome"])
            status = program.wait(_END_S)
        except (TimeoutError, subprocess.TimeoutExpired):
            return None, f"had not ended after {limit_s:.0f} s"
        finally:
            throttles.close()
            _end(program)
        errors.seek(0)
        said = [text for text in errors.read().splitlines() if text.strip()]
    last = said[-1] if said else "nothing"
    if status == 0 and outcome is not None:
        return outcome, ""
    if status == 2:
        return None, last
    raise TrialError(f"a trial's program ended with status {status}: {last}")


def _lines(program: subprocess.Popen[str], limit_s: float) -> Iterator[dict[str, Any]]:
    """What the program says until it closes its output; raises `TimeoutError`."""
    said: queue.SimpleQueue[str | None] = queue.SimpleQueue()

    def read(stream: IO[str]) -> None:
        for line in stream:
            said.put(line)
        said.put(None)

    assert program.stdout is not None
    threading.Thread(target=read, args=(program.stdout,), daemon=True).start()
    until_s = time.monotonic() + limit_s
    while True:
        try:
            line = said.get(timeout=max(0.0, until_s - time.monotonic()))
        except queue.Empty:
            raise TimeoutError from None
        if line is None:
            return
        with contextlib.suppress(ValueError):
            found = json.loads(line)
            if isinstance(found, dict) and "kind" in found:
                yield found


def _end(program: subprocess.Popen[str]) -> None:
    """Asks the program to end what it began; whoever does not is killed, with its session."""
    if program.poll() is None:
        program.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            program.wait(_END_S)
    if program.poll() is None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(program.pid, 9)
        program.wait()


def _machine_s() -> float:
    """Processor time that the whole machine has used (proc(5), stat; without idle and waiting)."""
    fields = [int(f) for f in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:]]
    busy = fields[0] + fields[1] + fields[2] + sum(fields[5:7])
    return busy / os.sysconf("SC_CLK_TCK")


def _own_s() -> float:
    """What this program and all that it started and has awaited has used of it."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system
