"""A long flight of the real program over a lossy link: memory flat, clock true, each frame told.

    python tests/faults/soak.py --minutes 30 --loss 0.02 --out out/soak.json

Prints a table and ends with status 1 when a bound is missed. pytest does not collect it.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from impaired_link import ImpairedLink, Impairment
from numpy.typing import NDArray
from payload_process import PayloadProcess
from witness import Witness

from ground_station.stream.feedback import Feedback
from ground_station.stream.receiver import Receiver
from ground_station.stream.telemetry import TelemetryListener

RATE_HZ = 30.0
SAMPLE_S = 10.0
SETTLED_S = 120.0
"""Until then buffers and caches may grow."""
FLAT = 0.02
"""Of the mean: how far memory may be off it, and how much it may grow over the flight."""
TRUE_S = 0.001
"""How far capture and wall clock may drift apart over the flight: what capture times promise."""
CLEAN_END_S = 3.0
_SEED = 4


@dataclass(frozen=True)
class Row:
    """One line of the table: a figure, its bound in words, and whether it holds."""

    name: str
    value: str
    bound: str
    holds: bool


@dataclass
class Flown:
    """What was measured: memory as (s, MB), of each frame seen (s, latency s), and all counts."""

    memory: list[tuple[float, float]]
    latency: list[tuple[float, float]]
    seen: list[int]
    counts: dict[str, int]
    status: int
    err: str
    witness: Witness
    link: dict[str, int]
    received: dict[str, int]


def memory_MB(pid: int) -> float:
    """A process's resident memory (proc(5), statm)."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def fly(duration_s: float, loss: float, camera: str, *, reports: bool) -> Flown:
    """The flight, with nothing kept of a frame but its number and its times.

    `reports`: the payload hears how its video arrives, as from a real ground station.
    """
    witness = Witness()
    memory: list[tuple[float, float]] = []
    latency: list[tuple[float, float]] = []
    seen: list[int] = []
    with contextlib.ExitStack() as stack:
        listener = stack.enter_context(TelemetryListener(["tcp/127.0.0.1:0"]))
        receiver = stack.enter_context(Receiver(0, queue_frames=1024))
        link = stack.enter_context(ImpairedLink(receiver.port, seed=_SEED, tap=witness))
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        payload = stack.enter_context(
            PayloadProcess(
                folder,
                f"camera.uri={camera}",
                f"camera.rate_hz={RATE_HZ}",
                f"link.port={link.port}",
                f"telemetry.connect={json.dumps(listener.endpoints)}",
            )
        )
        if reports:
            stack.enter_context(Feedback(listener, lambda _: receiver))
        start_s = sampled_s = time.monotonic()
        lossy = False
        while (now_s := time.monotonic()) < start_s + duration_s and payload.running:
            frame = receiver.get(0.2)
            if frame is not None:
                latency.append((now_s - start_s, (frame.arrival_ns - frame.clock_ns) / 1e9))
                seen.append(frame.sequence)
            # The first frames and the last pass: a receiver notices a loss by what comes after it.
            if lossy != (bool(seen) and now_s < start_s + duration_s - CLEAN_END_S):
                lossy = not lossy
                link.impair(Impairment(loss=loss if lossy else 0.0))
            if now_s >= sampled_s + SAMPLE_S:
                sampled_s += SAMPLE_S
                memory.append((sampled_s - start_s, memory_MB(payload.pid)))
                show(start_s, duration_s, memory[-1][1], len(seen))
        ended = payload.end()
        while frame := receiver.get(1.0):
            seen.append(frame.sequence)
        counters, counts = asdict(receiver.counters), asdict(link.counts)
    return Flown(
        memory, latency, seen, ended.counts, ended.status, ended.err, witness, counts, counters
    )


def show(start_s: float, duration_s: float, resident_MB: float, seen: int) -> None:
    """One line now and then, in place on a terminal."""
    passed_s = time.monotonic() - start_s
    line = f"{passed_s / 60:5.1f} of {duration_s / 60:g} min  {resident_MB:.1f} MB  {seen} frames"
    if sys.stderr.isatty():
        print(f"\r{line}", end="", file=sys.stderr, flush=True)
    elif int(passed_s / SAMPLE_S) % 12 == 0:
        print(line, file=sys.stderr, flush=True)


def slope(points: NDArray[np.float64]) -> float:
    """Of the least-squares line through (x, y) points, (N, 2)."""
    return float(np.polynomial.Polynomial.fit(points[:, 0], points[:, 1], 1).convert().coef[1])


def robust_slope(points: NDArray[np.float64]) -> float:
    """The same, but the median of all pairs' slopes (Sen, 1968): a busy minute does not tilt it."""
    first, second = np.triu_indices(len(points), 1)
    step = points[second] - points[first]
    return float(np.median(step[:, 1] / step[:, 0]))


def windows(latency: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of (s, latency s) points, (N, 2): time, least and median of each ten seconds, (M, 3).

    What delays a frame only ever adds: the least ones show how the two clocks stand.
    """
    number = (latency[:, 0] // SAMPLE_S).astype(int)
    parts = [latency[number == n] for n in np.unique(number)]
    return np.array([(part[:, 0].mean(), *np.quantile(part[:, 1], (0.0, 0.5))) for part in parts])


def rows(flown: Flown, duration_s: float) -> list[Row]:
    """The table."""
    return [
        Row("exit status", str(flown.status), "0", flown.status == 0 and not flown.err),
        *memory_rows(np.array(flown.memory), duration_s),
        *clock_rows(np.array(flown.latency), duration_s),
        *account_rows(flown),
    ]


def memory_rows(memory: NDArray[np.float64], duration_s: float) -> list[Row]:
    """Resident memory after the first two minutes."""
    settled = memory[memory[:, 0] > min(SETTLED_S, duration_s / 4)]
    mean = float(settled[:, 1].mean())
    off = float(abs(settled[:, 1] - mean).max()) / mean
    grown = slope(settled) * float(settled[-1, 0] - settled[0, 0]) / mean
    return [
        Row("memory, mean", f"{mean:.1f} MB", "120 MB", mean <= 120),
        Row("memory, off its mean", f"{100 * off:.2f} %", "2 %", off <= FLAT),
        Row("memory, trend over the flight", f"{100 * grown:+.2f} %", "2 %", abs(grown) <= FLAT),
    ]


def clock_rows(latency: NDArray[np.float64], duration_s: float) -> list[Row]:
    """The capture clock against the wall clock of the arrival."""
    quick = windows(latency)[:, :2]
    ppm = 1e6 * robust_slope(quick)
    drift_s = ppm * 1e-6 * duration_s
    off_s = float(abs(quick[:, 1] - np.median(quick[:, 1])).max())
    return [
        Row("capture clock, trend", f"{ppm:+.3f} ppm", "", True),
        Row("capture clock, drift", f"{1e3 * drift_s:+.3f} ms", "1 ms", abs(drift_s) <= TRUE_S),
        Row("capture clock, off its median", f"{1e3 * off_s:.3f} ms", "", True),
        Row("latency, median", f"{1e3 * float(np.median(latency[:, 1])):.2f} ms", "", True),
        Row("latency, longest", f"{1e3 * float(latency[:, 1].max()):.2f} ms", "", True),
    ]


def account_rows(flown: Flown) -> list[Row]:
    """The frames, end to end: each party's numbers against the others'."""
    counts, link, received, witness = flown.counts, flown.link, flown.received, flown.witness
    if not counts:
        return [Row("frames", "the payload printed no counters", "", False)]
    encoded = counts["captured"] - counts["gated"]
    left, visible = [frame.sequence for frame in witness.left()], witness.visible()
    damaged = sum(frame.damaged for frame in witness.left())
    lost = counts["sent"] - len(flown.seen)
    given_up = received["packets_late"] - link["duplicated"]
    return [
        Row("captured", str(counts["captured"]), "", counts["captured"] > 0),
        Row("gated", str(counts["gated"]), "", True),
        Row(
            "encoded, sent + discarded",
            f"{encoded} = {counts['sent']} + {counts['discarded']}",
            "exact",
            encoded == counts["sent"] + counts["discarded"],
        ),
        Row(
            "sent, seen to leave",
            f"{counts['sent']} = {len(left)}",
            "exact",
            left == sorted(set(left)) and len(left) == counts["sent"] and witness.gaps == 0,
        ),
        Row("received", str(len(flown.seen)), "", len(flown.seen) > 0),
        Row(
            "lost, damaged + following",
            f"{lost} = {damaged} + {len(left) - len(visible) - damaged}",
            "exact, one by one",
            flown.seen == visible,
        ),
        Row(
            "packets lost, on the link",
            f"{received['packets_lost']} = {link['lost']}",
            "exact",
            received["packets_lost"] - given_up == link["lost"]
            and received["packets"] == link["passed"] == link["received"] - link["lost"],
        ),
        Row("packets given up too early", str(given_up), "", True),
    ]


def main() -> int:
    """Flies, prints, writes; 1 when a bound is missed."""
    parser = argparse.ArgumentParser(description="A long flight over a lossy link.")
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--loss", type=float, default=0.02, help="share of packets, 0 to 1")
    parser.add_argument("--camera", default="test:", help="camera.uri (default: test:)")
    parser.add_argument("--silent", action="store_true", help="a ground that reports nothing")
    parser.add_argument("--out", type=Path, metavar="FILE", help="the figures as JSON")
    arguments = parser.parse_args()
    if not (2 <= arguments.minutes <= 10_000 and 0 <= arguments.loss < 1):
        parser.error("--minutes: 2 to 10000; --loss: 0 to 1")
    duration_s = 60 * arguments.minutes
    flown = fly(duration_s, arguments.loss, arguments.camera, reports=not arguments.silent)
    table = rows(flown, duration_s)
    print(f"\n{arguments.minutes:g} minutes at {RATE_HZ:g} Hz, {100 * arguments.loss:g} % loss")
    for row in table:
        verdict = ("ok" if row.holds else "MISSED") if row.bound or not row.holds else ""
        print(f"{row.name:32} {row.value:>24}  {row.bound:18} {verdict}")
    if arguments.out is not None:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        document: dict[str, Any] = {
            "minutes": arguments.minutes,
            "loss": arguments.loss,
            "rows": [asdict(row) for row in table],
            "memory_MB": flown.memory,
            "latency_s": windows(np.array(flown.latency)).tolist(),
            "link": flown.link,
            "received": flown.received,
        }
        arguments.out.write_text(json.dumps(document, indent=1) + "\n")
    return 0 if all(row.holds for row in table) else 1


if __name__ == "__main__":
    sys.exit(main())
