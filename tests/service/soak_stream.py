"""One unbroken stream of an hour through the process that localizes live, as fast as it takes it.

    python tests/service/soak_stream.py --hours 1 --out out/soak-stream.json

The sample's simulated flight is flown to and fro without end, at time stamps of 30 Hz; now and then
the lens is covered, so that the camera is lost and found. Each frame is shown when the one before
has its estimate. Prints a table, draws out/soak-stream.png and ends with status 1 when a bound is
missed; times are the stream's. Ctrl-C ends the run in order. pytest does not collect it.
"""

from __future__ import annotations

import contextlib
import queue
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import intake_stand  # noqa: F401 - it says where the other rooms' helpers are
import numpy as np
from localizing_stand import LIMIT_S, PAYLOAD, SAMPLE, Station, localizer
from soaking import report
from soaking.arguments import MOST_HOURS, Parser, number, on_interrupt
from soaking.judging import rows as slope_rows
from soaking.processes import Watch
from soaking.table import Row
from waiting import eventually

from ground_station.errors import GroundStationError
from ground_station.localization.estimate import State
from ground_station.recording.flight import FlightRecording
from ground_station.recording.frames import FrameRange
from ground_station.service import bus_messages
from ground_station.service.bus_messages import EstimateMessage

NAME = "localizer"
RATE_HZ = 30
STRETCH = FrameRange(0, 450)
"""Of the sample's flight: 15 s there and 15 s back."""
COVERED_EVERY, COVERED = 60 * RATE_HZ, 2 * RATE_HZ
"""Frames from one covering of the lens to the next, and how many show nothing."""
SAMPLE_EVERY, SAY_EVERY = 10 * RATE_HZ, 600 * RATE_HZ
SETTLED_S = 300.0
"""Until then buffers, caches and pools may grow; of a short run a sixth."""
# What would matter, an hour: as of the service's soak, for the same reasons.
MEMORY_MB, FILES = 10.0, 4.0


@dataclass
class Flown:
    """What was measured."""

    watch: Watch = field(default_factory=lambda: Watch({NAME: (MEMORY_MB, FILES)}))
    states: Counter[str] = field(default_factory=Counter)
    shown: int = 0
    skipped: int = 0
    lost: int = 0
    found_again: int = 0
    took_s: float = 0.0


def to_and_fro(images: Sequence[Any]) -> Iterator[Any]:
    """The pictures forwards and backwards by turns, without end."""
    while True:
        yield from images[:-1]
        yield from images[:0:-1]


def fly(options: Any, flown: Flown, interrupted: threading.Event) -> None:
    """Shows the stream's frames one by one."""
    images = [frame.image for frame in FlightRecording(SAMPLE / "flight.mcap", STRETCH)]
    covered = np.zeros_like(images[0])
    said: queue.SimpleQueue[EstimateMessage] = queue.SimpleQueue()
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        told = stack.enter_context(Station(folder))
        process = stack.enter_context(localizer(folder))
        told.bus.subscribe(
            bus_messages.ESTIMATE, EstimateMessage, lambda _, note: said.put(note), PAYLOAD
        )
        eventually(lambda: told.event("map-loaded") is not None, what="the map")
        start_s, lost = time.monotonic(), False
        for k, image in zip(
            range(round(3600 * options.hours * RATE_HZ)), to_and_fro(images), strict=False
        ):
            if interrupted.is_set():
                break
            hidden = k >= COVERED_EVERY and k % COVERED_EVERY < COVERED
            told.show(covered if hidden else image, k, round(k * 1e9 / RATE_HZ))
            note = said.get(timeout=LIMIT_S)
            if note.state == State.LOST.value:
                time.sleep(1.0 / RATE_HZ)  # frames of no work outrun the search for the camera
            told.estimates.clear()  # or this program would grow
            flown.states[note.state] += 1
            flown.shown, flown.skipped = k + 1, note.skipped
            flown.lost += not lost and note.state == State.LOST.value
            flown.found_again += lost and note.state == State.TRACKING.value
            lost = note.state == State.LOST.value or (lost and note.state != State.TRACKING.value)
            if k % SAMPLE_EVERY == 0:
                flown.watch.sample(k / RATE_HZ, {NAME: process.pid})
            if k % SAY_EVERY == 0:
                memory = flown.watch.last_MB()[NAME]
                print(f"{k / RATE_HZ / 60:5.1f} min {memory:7.1f} MB {k} frames", flush=True)
        flown.took_s = time.monotonic() - start_s


def rows(flown: Flown, options: Any) -> list[Row]:
    """The table."""
    wanted = round(3600 * options.hours * RATE_HZ)
    return [
        *slope_rows(flown.watch.measures, settled_s(options)),
        Row("frames of one stream", str(flown.shown), str(wanted), flown.shown == wanted),
        Row("frames skipped", str(flown.skipped), "0", flown.skipped == 0),
        Row(
            "times lost, and found again",
            f"{flown.lost}, {flown.found_again}",
            "alike",
            flown.lost == flown.found_again,
        ),
        Row("states", str(dict(flown.states))),
        Row("faster than real time by", f"{flown.shown / RATE_HZ / max(flown.took_s, 1e-9):.2f}"),
    ]


def settled_s(options: Any) -> float:
    """From when slopes are judged."""
    return min(SETTLED_S, 600.0 * options.hours)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs, prints, writes, draws; 1 when a bound is missed, 2 for bad input."""
    parser = Parser(prog="soak", description="One long stream through the live localizer.")
    parser.add_argument("--hours", type=number(0.05, MOST_HOURS), default=1.0, metavar="H")
    parser.add_argument("--out", type=Path, metavar="FILE", help="figures as JSON; a PNG beside")
    options, flown = parser.parse_args(arguments), Flown()
    try:
        fly(options, flown, on_interrupt())
        title = f"Soak: one stream of {options.hours:g} h, stepped; simulated flight"
        return report.conclude(
            rows(flown, options),
            flown.watch.measures,
            settled_s(options),
            {"title": title},
            options.out,
        )
    except GroundStationError as error:
        print(f"soak: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
