"""One trial: a flight, or the whole service with several payloads, and its share of TRACKING.

A program of its own, `python tests/hil/limits_trial.py TRIAL.json`, so that who limits it stands
outside. It says on standard output, one JSON object a line: "flying" with the payload's process
once the first frame is there, "landed" when that process is about to be ended, and "result". What a
person must know goes to standard error; the status is 2 when the burden was such that no video came
or the firmware gave up, and 1 for what is no matter of burdens.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from ground_station.replay.live import LiveFrame

TESTS = Path(__file__).resolve().parents[1]
SETTLE_S = 3.0
"""From when all payloads are tracked to the first frame that counts, and how long one flight may
search for its place before its frames count."""
TRACKING_S = 90.0
LATE_S = 3.0
SEAM_S = 2.0
"""A flight in a loop begins again elsewhere: this much of each round says nothing of a limit."""


@dataclass(frozen=True)
class Trial:
    """What the program is told. Ports of 0: any free one, and no link between."""

    recording: str
    map: str
    rate_hz: float
    duration_s: float
    payload: tuple[str, ...] = ()
    video_port: int = 0
    link_port: int = 0
    payloads: int = 0
    """0: one flight, as `blimp replay` flies it."""


@dataclass(frozen=True)
class Outcome:
    """`due` are the frames that a camera had to give, `tracking` those of them called TRACKING.

    Both count from when the place was found, and of several payloads are the worst one's. Latencies
    are in ms and of all of them, memory and processor of one flight's two sides (MB, cores); None
    where it is not known.
    """

    due: int
    tracking: int
    latency_p50_ms: float | None = None
    latency_p99_ms: float | None = None
    received: int | None = None
    ground_cores: float | None = None
    payload_cores: float | None = None
    worst: str = ""

    @property
    def share(self) -> float:
        """0 to 1; 0 of nothing."""
        return min(1.0, self.tracking / self.due) if self.due > 0 else 0.0


def say(kind: str, **more: Any) -> None:
    """One line to whoever started this."""
    print(json.dumps({"kind": kind, **more}), flush=True)


def due(captured: int, clock_ns: list[int], rate_hz: float) -> int:
    """The frames that a camera gave, or would have given in the time that the flight took.

    A replayed camera waits for a firmware that is too slow, so that the flight takes longer and
    loses nothing; a real one would not: its frames are counted by the clock then.
    """
    span_s = (max(clock_ns) - min(clock_ns)) / 1e9 if clock_ns else 0.0
    return max(captured, round(span_s * rate_hz) + (1 if clock_ns else 0))


def fly(trial: Trial) -> Outcome:
    """One flight, as `blimp replay` flies it. Raises a `BlimpError` when it cannot be flown."""
    from ground_station.map import store
    from ground_station.replay.replay import replay, settings_for
    from ground_station.replay.rig import LOOPBACK, Rig, Running
    from ground_station.service.settings import VideoSettings

    flown: list[Running] = []

    @contextlib.contextmanager
    def payload(config: dict[str, Any], folder: Path) -> Iterator[Running]:
        with LOOPBACK.payload(config, folder) as running:
            flown.append(running)
            try:
                yield running
            finally:
                say("landed")

    settings = settings_for(
        "default",
        Path(trial.recording),
        rate_hz=trial.rate_hz,
        duration_s=trial.duration_s,
        payload=tuple(trial.payload),
        pictures=1,
    )
    rig = Rig(
        payload=payload,
        link=lambda port: contextlib.nullcontext(trial.link_port or port),
        video=VideoSettings(port=trial.video_port),
        on_first_frame=lambda: say("flying", payload=flown[0].pid()),
    )
    result = replay(store.load(Path(trial.map)), settings, rig)
    live = result.live
    latency = live.latency_ms()
    p50, p99 = np.quantile(latency, (0.5, 0.99)) if len(latency) else (None, None)
    captured, frames = live.accounts()["captured"], since_found(live.frames)
    if frames:
        captured -= frames[0].sequence
    return Outcome(
        due=due(captured, [frame.clock_ns for frame in frames or live.frames], trial.rate_hz),
        tracking=sum(_tracking(frame) for frame in frames),
        latency_p50_ms=None if p50 is None else float(p50),
        latency_p99_ms=None if p99 is None else float(p99),
        received=live.accounts()["received"],
        ground_cores=result.ground_side.cpu,
        payload_cores=result.payload_side.cpu if result.payload_side else None,
    )


def since_found(frames: list[LiveFrame]) -> list[LiveFrame]:
    """The frames from the first TRACKING one on: what comes before is the search for the place.

    A search that takes longer than `SETTLE_S` counts from then on.
    """
    for n, frame in enumerate(frames):
        if _tracking(frame) or frame.clock_ns - frames[0].clock_ns >= SETTLE_S * 1e9:
            return frames[n:]
    return []


def _tracking(frame: LiveFrame) -> bool:
    return frame.estimate.state.value == "TRACKING"


@dataclass(frozen=True)
class Round:
    """A flight flown in a loop: the recorded time of its first frame, and a round's length."""

    first_ns: int
    length_ns: int

    def counts(self, time_ns: int) -> bool:
        """Whether a frame with this (rising) recorded time is none of a seam's."""
        return (time_ns - self.first_ns) % self.length_ns >= SEAM_S * 1e9

    def due(self, from_ns: int, to_ns: int, rate_hz: float) -> int:
        """How many frames that count lie in [from, to), to the nearest one."""
        step_ns = 1e9 / rate_hz
        times = from_ns + step_ns * np.arange(round((to_ns - from_ns) / step_ns))
        return int(((times - self.first_ns) % self.length_ns >= SEAM_S * 1e9).sum())


def round_of(recording: Path) -> Round:
    """A recording's round as `replay:…?loop=1` flies it."""
    from pi_firmware.wire.recording import RecordingReader

    times = [sample.time_ns for sample in RecordingReader(recording).video()]
    return Round(times[0], times[-1] - times[0] + (times[-1] - times[-2]))


class Heard:
    """Every estimate on the service's bus, by payload: recorded time, TRACKING or not, latency."""

    def __init__(self, bus: Any) -> None:
        from ground_station.service import bus_messages

        self.frames: dict[str, list[tuple[int, bool, float | None]]] = {}
        bus.subscribe(bus_messages.ESTIMATE, bus_messages.EstimateMessage, self._take)

    def _take(self, payload_id: str, note: Any) -> None:
        known = note.capture_ns is not None and note.position_m is not None
        latency_ms = 1e-6 * (note.done_ns - note.capture_ns) if known else None
        frame = (note.time_ns, note.state == "TRACKING", latency_ms)
        self.frames.setdefault(payload_id, []).append(frame)

    def newest_ns(self, payload_id: str) -> int | None:
        """The recorded time of the newest frame of which there is an estimate."""
        frames = self.frames.get(payload_id)
        return frames[-1][0] if frames else None


def judge(
    frames: Mapping[str, list[tuple[int, bool, float | None]]],
    from_ns: Mapping[str, int],
    round_: Round,
    trial: Trial,
) -> Outcome:
    """The worst payload's share of the frames due in the time that was looked at."""
    outcomes: list[Outcome] = []
    latency: list[float] = []
    for name, start_ns in from_ns.items():
        end_ns = start_ns + int(1e9 * trial.duration_s)
        inside = [frame for frame in frames.get(name, []) if start_ns <= frame[0] < end_ns]
        latency += [one[2] for one in inside if one[2] is not None]
        tracking = sum(one[1] for one in inside if round_.counts(one[0]))
        wanted = round_.due(start_ns, end_ns, trial.rate_hz)
        outcomes.append(Outcome(wanted, tracking, worst=name))
    worst = min(outcomes, key=lambda one: one.share)
    p50, p99 = np.quantile(latency, (0.5, 0.99)) if latency else (None, None)
    return Outcome(
        worst.due,
        worst.tracking,
        None if p50 is None else float(p50),
        None if p99 is None else float(p99),
        worst=worst.worst,
    )


def serve(trial: Trial) -> Outcome:
    """The whole service with several payloads. Shares are 0 where one is never tracked."""
    sys.path[:0] = [str(TESTS / "service")]
    from standing import Service

    round_ = round_of(Path(trial.recording))
    names = [f"blimp-{number + 1}" for number in range(trial.payloads)]
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        most = f"payloads.most={trial.payloads}"
        service = stack.enter_context(Service(folder, most, payloads=names))
        heard = Heard(stack.enter_context(service.bus()))
        for name in names:
            stack.enter_context(service.fly(name, folder / name, rate_hz=trial.rate_hz))
        until_s = time.monotonic() + TRACKING_S
        while not all(service.tracking(name) for name in names):
            if time.monotonic() > until_s:
                missing = ", ".join(name for name in names if not service.tracking(name))
                wanted = round(trial.duration_s * trial.rate_hz)
                return Outcome(wanted, 0, worst=f"{missing}: never tracked")
            time.sleep(0.2)
        time.sleep(SETTLE_S)
        # Of a payload that has fallen silent meanwhile all that is due from now on is missing.
        from_ns = {name: heard.newest_ns(name) or round_.first_ns for name in names}
        time.sleep(trial.duration_s + LATE_S)
        return judge(heard.frames, from_ns, round_, trial)


def main(path: str) -> int:
    """Reads the trial, flies it, says the result."""
    from ground_station.replay.rig import FirmwareError
    from pi_firmware.wire.errors import BlimpError, StreamError

    # Whoever started this ends it so: everything that it began is ended as after a flight.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    trial = Trial(**json.loads(Path(path).read_text()))
    try:
        outcome = serve(trial) if trial.payloads else fly(trial)
    except BlimpError as error:
        print(error, file=sys.stderr)
        gave_up = isinstance(error, FirmwareError) and "status 2:" not in str(error)
        return 2 if gave_up or isinstance(error, StreamError) else 1
    say("result", outcome=asdict(outcome))
    return 0


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.exit(main(sys.argv[1]))
