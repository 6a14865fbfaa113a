"""Faults across payload and ground station, and whether the invariants hold.

    python tests/faults/scenarios/run.py matrix [--only outage]
    python tests/faults/scenarios/run.py walks --seed 1 --walks 15
    python tests/faults/scenarios/run.py walks --seed 7 --walks 1 --shrink   # a short reproduction
    python tests/faults/scenarios/run.py again FOLDER/scenario-0.json

Prints what was injected, a table of all invariants, and ends with status 1 when one was broken. The
folder of a run that broke one is kept, with its steps, its story, logs and recordings.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from ground_station.files import write_json
from ground_station.presentation.text import columns
from scenarios import disk
from scenarios.camera import Cameras
from scenarios.judge import INVARIANTS, Verdict
from scenarios.matrix import MATRIX, named
from scenarios.play import RECOVERED_S, STARTED_S, found, play
from scenarios.step import Scenario, StepError, as_json, from_json
from scenarios.walk import WALK_S, drawn, shrunk
from scenarios.world import RATE_HZ, shims_there

LONG_WALKS, LONG_S = 60, 120.0
BAD_INPUT = 2


def main() -> int:
    """Runs, prints, writes; 1 when an invariant was broken, 2 for bad input."""
    arguments = _arguments()
    try:
        scenarios = _chosen(arguments)
    except (StepError, OSError) as error:
        print(f"run.py: {error}", file=sys.stderr)
        return BAD_INPUT
    if not shims_there():
        print("run.py: no C compiler (cc): clocks and encoder cannot be disturbed", file=sys.stderr)
        return BAD_INPUT
    has_disk = disk.alone()
    if any(one.disk_MB for one in scenarios) and not has_disk:
        print("left out: a disk of its own needs root and unshare(2)", flush=True)
        scenarios = [one for one in scenarios if not one.disk_MB]
    place = Path(tempfile.mkdtemp(prefix="scenarios-", dir=arguments.keep))
    runner = Runner(place, arguments.seed, arguments.rate_hz)
    flights = grouped(scenarios, arguments.together)
    stopped = False
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # a flight ends all that it started
    try:
        for number, flight in enumerate(flights):
            print(f"flight {number + 1} of {len(flights)}", flush=True)
            runner.fly(flight, f"{number:02d}", shrink=arguments.shrink)
    except KeyboardInterrupt:
        print("stopped; what had ended is told", file=sys.stderr)
        stopped = True
    _table(runner.verdicts)
    _write(arguments.out, arguments.what, runner.verdicts, scenarios)
    return 0 if all(verdict.holds for verdict in runner.verdicts) and not stopped else 1


class Runner:
    """Flies scenarios and prints what came of each."""

    def __init__(self, place: Path, seed: int, rate_hz: float) -> None:
        self.verdicts: list[Verdict] = []
        self._place, self._seed, self._rate_hz = place, seed, rate_hz
        self._cameras = Cameras(place)

    def fly(self, flight: Sequence[Scenario], name: str, *, shrink: bool) -> None:
        """One flight; when it breaks an invariant, again each of its scenarios alone.

        Where none of these does, it was what one left to the next, and the flight's verdict stays.
        """
        verdicts = self._play(flight, name)
        if not all(verdict.holds for verdict in verdicts) and len(flight) > 1:
            print("  each alone:", flush=True)
            alone = [self._play([one], f"{name}-{n}") for n, one in enumerate(flight)]
            if not all(verdict.holds for (verdict,) in alone):
                verdicts = [verdict for (verdict,) in alone]
        elif shrink and not verdicts[0].holds:
            self._shrink(flight[0], name)
        self.verdicts += verdicts

    def _play(self, flight: Sequence[Scenario], name: str) -> list[Verdict]:
        for scenario in flight:
            print(f"  {scenario.name}", flush=True)
            for step in scenario.steps:
                print(f"      {step}", flush=True)
        began_s = time.monotonic()
        folder = self._place / name
        verdicts = play(folder, self._cameras, flight, seed=self._seed, rate_hz=self._rate_hz)
        load = os.getloadavg()[0]
        for verdict in verdicts:
            verdict.figures |= {"flight_s": round(time.monotonic() - began_s, 1), "load": load}
        for line in found(verdicts):
            print(f"  BROKEN {line}", flush=True)
        if not all(verdict.holds for verdict in verdicts):
            print(f"  kept: {folder}", flush=True)
        return verdicts

    def _shrink(self, scenario: Scenario, name: str) -> None:
        tried = 0

        def fails(fewer: Scenario) -> bool:
            nonlocal tried
            tried += 1
            (verdict,) = self._play([fewer], f"{name}-fewer-{tried:02d}")
            return not verdict.holds

        least = shrunk(scenario, fails)
        (self._place / name / "shrunk.json").write_text(as_json(least))
        print("  the least that fails:", flush=True)
        for step in least.steps:
            print(f"      {step}", flush=True)


def grouped(scenarios: Sequence[Scenario], together: int) -> list[list[Scenario]]:
    """Flights of so many scenarios at most, of those that need the same service."""
    flights: list[list[Scenario]] = []
    open_ones: dict[tuple[int, bool], list[Scenario]] = {}
    for scenario in scenarios:
        needs = scenario.disk_MB, scenario.foxglove
        flight = open_ones.get(needs)
        if flight is None or len(flight) >= together:
            flight = open_ones[needs] = []
            flights.append(flight)
        flight.append(scenario)
    return flights


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Faults across payload and ground station.")
    parser.add_argument("what", choices=("matrix", "walks", "again"))
    parser.add_argument("file", nargs="?", type=Path, help="of `again`: a scenario as it was kept")
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="NAME", help="scenarios with this in the name"
    )
    parser.add_argument("--seed", type=int, default=1, help="of the first walk")
    parser.add_argument("--walks", type=int, default=15, help="of 30 s each")
    long = f"{LONG_WALKS} walks of {LONG_S:g} s"
    parser.add_argument("--long", action="store_true", help=long)
    parser.add_argument("--rate-hz", type=float, default=RATE_HZ, help="the payload's, 2 to 30")
    parser.add_argument("--together", type=int, default=0, help="scenarios a flight (6; walks: 1)")
    parser.add_argument("--shrink", action="store_true", help="finds the fewest steps that fail")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="where folders are kept")
    parser.add_argument("--out", type=Path, metavar="FILE", help="all of it as JSON")
    parser.add_argument("--list", action="store_true", help="prints the scenarios only")
    arguments = parser.parse_args()
    if not (1 <= arguments.walks <= 10_000 and 0 <= arguments.seed < 1 << 31):
        parser.error("--walks: 1 to 10000; --seed: 0 to 2147483647")
    if (arguments.what == "again") != (arguments.file is not None):
        parser.error("again, and only again, takes a FILE")
    if arguments.keep is not None and not arguments.keep.is_dir():
        parser.error(f"--keep {arguments.keep}: no such folder")
    if not 2 <= arguments.rate_hz <= 30:
        parser.error("--rate-hz: 2 to 30")
    if not 0 <= arguments.together <= 100:
        parser.error("--together: 1 to 100")
    if arguments.together == 0:
        arguments.together = 6 if arguments.what == "matrix" else 1
    if arguments.list:
        for scenario in MATRIX:
            print(f"{scenario.name}: {'; '.join(map(str, scenario.steps))}")
        parser.exit()
    return arguments


def _chosen(arguments: argparse.Namespace) -> list[Scenario]:
    if arguments.what == "again":
        return [from_json(arguments.file.read_text())]
    if arguments.what == "walks":
        count, span_s = (LONG_WALKS, LONG_S) if arguments.long else (arguments.walks, WALK_S)
        return [drawn(arguments.seed + n, span_s) for n in range(count)]
    scenarios = named(*arguments.only)
    if not scenarios:
        raise StepError(
            f"--only {' '.join(arguments.only)}: no scenario has this in its name (--list)"
        )
    return scenarios


def _table(verdicts: Sequence[Verdict]) -> None:
    rows = [["scenario", *INVARIANTS, "back", "lost", "burden", "off"]]
    for verdict in verdicts:
        back_s = verdict.figures.get("recovery_s")
        back = "never" if back_s is None else f"{back_s:.1f} s"
        off = f"{verdict.figures.get('off_m', float('nan')):.2f} m"
        burden = f"{verdict.figures.get('burden', 1.0):.1f}"
        held = ("BROKEN" if verdict.broken[name] else "ok" for name in INVARIANTS)
        lost = f"{verdict.figures.get('lost', '?')} of {verdict.figures.get('left', '?')}"
        rows.append([verdict.name[:42], *held, back, lost, burden, off])
    print("", *columns(rows), sep="\n")
    peaks_MB: dict[str, float] = {}
    for verdict in verdicts:
        for name, peak_MB in verdict.figures.get("peaks_MB", {}).items():
            peaks_MB[name] = max(peak_MB, peaks_MB.get(name, 0.0))
    print("most memory, MB:", *(f"{name} {peak:.0f}" for name, peak in peaks_MB.items()))
    holding = sum(verdict.holds for verdict in verdicts)
    print(
        f"{holding} of {len(verdicts)} hold; bounds: 0.5 m, back within {RECOVERED_S:g} s, or"
        f" {STARTED_S:g} s where a process restarts, times the machine's burden"
    )


def _write(
    out: Path | None, what: str, verdicts: Sequence[Verdict], scenarios: Sequence[Scenario]
) -> None:
    if out is None:
        return
    out.parent.mkdir(parents=True, exist_ok=True)
    document = {
        "what": what,
        "verdicts": [dataclasses.asdict(verdict) for verdict in verdicts],
        "scenarios": [json.loads(as_json(scenario)) for scenario in scenarios],
    }
    write_json(out, document)


if __name__ == "__main__":
    sys.exit(main())
