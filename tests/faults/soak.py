"""A long flight of the real program over a lossy link: no leaks, no frame unaccounted for.

    python tests/faults/soak.py --hours 0.5 --loss 0.02 --out out/soak.json

Prints a table, draws out/soak.png and ends with status 1 when a bound is missed. Ctrl-C ends the
flight in order and judges what was measured. pytest does not collect it.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from impaired_link import ImpairedLink, Impairment
from payload_process import PayloadProcess
from soak_account import Account, account_rows
from soaking import report
from soaking.arguments import MOST_HOURS, Parser, number, on_interrupt
from soaking.judging import rows as slope_rows
from soaking.measures import CLOCK, LATENCY, MEMORY, Measure, Windows
from soaking.processes import Watch
from soaking.table import Row
from soaking.trend import trend
from witness import Witness

sys.path.append(str(Path(__file__).resolve().parents[1] / "stream"))

from receiving import Receiver

from ground_station.errors import GroundStationError
from ground_station.keys.authority import Authority
from ground_station.stream.feedback import Feedback
from ground_station.stream.srtp import load_keys
from ground_station.stream.telemetry import TelemetryListener

RATE_HZ = 30.0
SAMPLE_S = 10.0
SETTLED_S = 120.0
"""Until then buffers and caches may grow."""
KEEP_S = 300.0
"""How often what was measured is written meanwhile: what a lost supply costs."""
CLEAN_END_S = 3.0
MOST_MB = 120.0
FLAT = 0.02
"""Of the mean: how far the payload's memory may be off it."""
TRUE_S = 0.001
"""How far capture and wall clock may drift apart over the flight: what capture times promise."""
_SEED = 4

NAME = "blimp-1"
PAYLOAD, HERE = "payload", "this program"
# What would matter, an hour. A payload of 512 MB and 1,024 descriptors that stays on for a day: 24
# MB and 192 descriptors. (Of a slow counter half an hour tells no less than 7 an hour from 0.)
# This program's own memory grows by design: it keeps every frame's number.
BOUNDS = {PAYLOAD: (1.0, 8.0), HERE: (None, 8.0)}
MEDIAN_MS, P99_MS = 5.0, 50.0


@dataclass
class Flown:
    """What was measured over the time, and the account of the end."""

    watch: Watch
    median: Measure
    p99: Measure
    clock: Measure
    account: Account
    load: list[float]
    longest_ms: float = 0.0
    flown_s: float = 0.0

    @property
    def measures(self) -> list[Measure]:
        """All that is drawn and judged."""
        return [*self.watch.measures, self.median, self.p99, self.clock]


def nothing() -> Flown:
    """What has been measured before the start."""
    return Flown(
        Watch(BOUNDS),
        Measure(LATENCY, "median", "ms", MEDIAN_MS),
        Measure(LATENCY, "p99", "ms", P99_MS),
        # Drawn; what it promises, over the flight and not an hour, is a row of its own.
        Measure(CLOCK, "capture against arrival", "ms"),
        Account(),
        [],
    )


def fly(flown: Flown, options: Any, interrupted: threading.Event) -> None:
    """The flight, with nothing kept of a frame but its number; ends early when interrupted."""
    duration_s, account = 3600.0 * options.hours, flown.account
    windows = Windows(SAMPLE_S)
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        authority = Authority.create(folder / "keys")
        ground, certificates = authority.add("ground", "main"), authority.add("payload", NAME)
        keys = load_keys(ground)
        account.witness = Witness(keys)
        listener = stack.enter_context(TelemetryListener(["tls/127.0.0.1:0"], certificates=ground))
        receiver = stack.enter_context(Receiver(0, queue_frames=1024, srtp_keys=keys))
        link = stack.enter_context(ImpairedLink(receiver.port, seed=_SEED, tap=account.witness))
        payload = stack.enter_context(
            PayloadProcess(
                folder,
                f"camera.uri={options.camera}",
                f"camera.rate_hz={RATE_HZ}",
                f"link.port={link.port}",
                "link.correction=0",
                "link.history_s=0",  # what the link loses stays lost: each frame can be told
                f"payload_id={NAME}",
                f"telemetry.connect={json.dumps(listener.endpoints)}",
                f"telemetry.certificates={certificates}",
                prefix=("setsid",),  # a Ctrl-C is ours: the flight ends as it always does
            )
        )
        if not options.silent:
            stack.enter_context(Feedback(listener, lambda _: receiver))
        start_s = sampled_s = kept_s = time.monotonic()
        lossy = False
        while (now_s := time.monotonic()) < start_s + duration_s and payload.running:
            if interrupted.is_set():
                break
            frame = receiver.get(0.2)
            if frame is not None:
                account.take(frame)
                _take(flown, windows, now_s - start_s, (frame.arrival_ns - frame.clock_ns) / 1e6)
            # The first frames and the last pass: a receiver notices a loss by what comes after it.
            if lossy != (bool(account.seen) and now_s < start_s + duration_s - CLEAN_END_S):
                lossy = not lossy
                link.impair(Impairment(loss=options.loss if lossy else 0.0))
            if now_s >= sampled_s + SAMPLE_S:
                sampled_s += SAMPLE_S
                flown.watch.sample(sampled_s - start_s, {PAYLOAD: payload.pid, HERE: os.getpid()})
                flown.load.append(os.getloadavg()[0])
                say(now_s - start_s, duration_s, flown)
            if options.out is not None and now_s >= kept_s + KEEP_S:
                kept_s = now_s
                report.write(options.out, flown.measures, settled_s(options), about(options, flown))
        link.impair(Impairment())
        flown.flown_s = time.monotonic() - start_s
        ended = payload.end()
        while frame := receiver.get(1.0):
            account.take(frame)
        account.received, account.link = asdict(receiver.counters), asdict(link.counts)
    account.counts, account.status, account.err = ended.counts, ended.status, ended.err


def _take(flown: Flown, windows: Windows, at_s: float, latency_ms: float) -> None:
    """One frame's way. What delays a frame only ever adds: the least ones show the clocks."""
    flown.longest_ms = max(flown.longest_ms, latency_ms)
    window = windows.add(at_s, latency_ms)
    if window is not None:
        flown.median.add(window.at_s, window.median)
        flown.p99.add(window.at_s, window.p99)
        flown.clock.add(window.at_s, window.least)


def say(passed_s: float, duration_s: float, flown: Flown) -> None:
    """One line now and then, in place on a terminal."""
    memory = flown.watch.last_MB().get(PAYLOAD, float("nan"))
    seen = len(flown.account.seen)
    line = f"{passed_s / 60:5.1f} of {duration_s / 60:g} min  {memory:.1f} MB  {seen} frames"
    if sys.stderr.isatty():
        print(f"\r{line}", end="", file=sys.stderr, flush=True)
    elif int(passed_s / SAMPLE_S) % 12 == 0:
        print(line, file=sys.stderr, flush=True)


def settled_s(options: Any) -> float:
    """From when slopes are judged; a short trial has less to settle in."""
    return min(SETTLED_S, 900.0 * options.hours)


def rows(flown: Flown, options: Any) -> list[Row]:
    """The table."""
    from_s = settled_s(options)
    return [
        *level_rows(flown.watch.measures, from_s),
        *slope_rows(flown.measures, from_s),
        *clock_rows(flown.clock, flown.flown_s),
        Row("latency, longest", f"{flown.longest_ms:.2f} ms"),
        Row(
            "load average", f"{min(flown.load, default=0):.1f} to {max(flown.load, default=0):.1f}"
        ),
        *account_rows(flown.account),
    ]


def level_rows(measures: Sequence[Measure], from_s: float) -> list[Row]:
    """The payload's resident memory once it had settled."""
    memory = next((m for m in measures if (m.kind, m.name) == (MEMORY, PAYLOAD)), None)
    settled = np.empty((0, 2)) if memory is None else memory.settled(from_s)
    if not len(settled):
        return [Row("memory, payload: mean", "no sample", "", False)]
    mean = float(settled[:, 1].mean())
    off = float(abs(settled[:, 1] - mean).max()) / mean
    return [
        Row("memory, payload: mean", f"{mean:.1f} MB", f"{MOST_MB:g} MB", mean <= MOST_MB),
        Row("memory, payload: off its mean", f"{100 * off:.2f} %", "2 %", off <= FLAT),
    ]


def clock_rows(clock: Measure, flown_s: float) -> list[Row]:
    """The capture clock against the wall clock of the arrival."""
    points = clock.settled(0.0)
    found = trend(points)
    drift_ms = found.slope * flown_s / 3600.0
    holds = abs(drift_ms) <= 1e3 * TRUE_S  # false for NaN, too
    off_ms = float(abs(points[:, 1] - np.median(points[:, 1])).max()) if len(points) else math.nan
    drift = f"{drift_ms:+.3f} ms" if math.isfinite(drift_ms) else "?"
    return [
        Row("clock, drift over the flight", drift, f"±{1e3 * TRUE_S:g} ms", holds),
        Row("clock, off its median", f"{off_ms:.3f} ms" if math.isfinite(off_ms) else "?"),
    ]


def about(options: Any, flown: Flown) -> dict[str, Any]:
    """What the figures are of."""
    return {
        "title": f"Soak: the payload's firmware, {options.hours:g} h at {RATE_HZ:g} Hz,"
        f" {100 * options.loss:g} % loss; {options.camera}",
        "hours": options.hours,
        "flown_h": flown.flown_s / 3600.0,
        "loss": options.loss,
        "camera": options.camera,
        "load": flown.load,
        "link": flown.account.link,
        "received": flown.account.received,
    }


def parser() -> Parser:
    """The command line."""
    result = Parser(prog="soak", description="A long flight over a lossy link.")
    result.add_argument("--hours", type=number(0.02, MOST_HOURS), default=0.5, metavar="H")
    result.add_argument(
        "--loss", type=number(0, 0.9), default=0.02, help="share of packets, 0 to 0.9"
    )
    result.add_argument("--camera", default="test:", help="camera.uri (default: test:)")
    result.add_argument("--silent", action="store_true", help="a ground that reports nothing")
    result.add_argument("--out", type=Path, metavar="FILE", help="figures as JSON; a PNG beside")
    result.add_argument(
        "--again", type=Path, metavar="FILE", help="judge and draw an earlier run's"
    )
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Flies, prints, writes, draws; 1 when a bound is missed, 2 for bad input."""
    options = parser().parse_args(arguments)
    try:
        if options.again is not None:
            table, drawn = report.again(options.again)
            print(drawn)
            return report.conclude(table, (), 0.0, {}, None)
        return run(options)
    except GroundStationError as error:
        print(f"soak: {error}", file=sys.stderr)
        return 2


def run(options: Any) -> int:
    """A flight from its start to its table."""
    flown = nothing()
    fly(flown, options, on_interrupt())
    table = rows(flown, options)
    print(f"\n{flown.flown_s / 3600:.3g} of {options.hours:g} hours at {RATE_HZ:g} Hz")
    settled, told = settled_s(options), about(options, flown)
    return report.conclude(table, flown.measures, settled, told, options.out)


if __name__ == "__main__":
    sys.exit(main())
