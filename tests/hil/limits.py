"""What loss, latency, bit rate, processor share and number of payloads the system bears.

    python tests/hil/limits.py --out out/limits.json
    python tests/hil/limits.py --out out/limits.json --only loss,latency --quick
    python tests/hil/limits.py --out out/limits.json --accept      # its table into README

Each axis is searched for the highest level at which every seed keeps 95 % of the captured frames
TRACKING. Results are kept after each trial: a run that was stopped goes on where it was when it is
started with the same --out. Measure on a quiet machine: what others use of it is measured, too.
Status 1: an axis was not measured to its end.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from limits_axes import AXES, BORNE, Axis, Conditions, Found, chosen, search
from limits_stand import Flight, Measured, TrialError, measure
from limits_store import QUIET_CORES, Store, accept, read, render
from limits_throttle import method
from soaking.arguments import Parser

from ground_station.errors import GroundStationError
from ground_station.files import write_text

ATRIUM = Path(__file__).resolve().parents[2] / "maps" / "atrium"
SEEDS, QUICK_SEEDS = (1, 2, 3), (1, 2)
WHOLE_S, QUICK_S = 32.0, 16.0
BUSY_LOAD = 0.5

Measure = Callable[[Flight, Conditions, int], Measured]


def parser() -> Parser:
    """The command line."""
    result = Parser(
        prog="limits",
        description=(__doc__ or "").split("\n")[0],
        epilog="axes: " + ", ".join(axis.name for axis in AXES),
    )
    result.add_argument(
        "--out", type=Path, default=Path("out/limits.json"), metavar="FILE",
        help="trials and limits; a table in Markdown beside (default: out/limits.json)",
    )  # fmt: skip
    result.add_argument("--only", default="", metavar="AXIS,…", help="these axes (default: all)")
    result.add_argument(
        "--quick", action="store_true", help=f"{QUICK_S:g} s and {len(QUICK_SEEDS)} seeds a level"
    )
    result.add_argument(
        "--undisturbed", action="store_true",
        help=f"measure again where others used more than {QUIET_CORES:g} cores meanwhile",
    )  # fmt: skip
    result.add_argument(
        "--accept", action="store_true", help="measure nothing: take --out's table into README"
    )
    return result


def run(
    axes: Sequence[Axis], flight: Flight, store: Store, seeds: Sequence[int], fly: Measure
) -> bool:
    """Searches the axes one after the other; whether all were measured to their ends.

    A Ctrl-C keeps what was measured and is passed on.
    """
    whole = True
    for axis in axes:
        found = Found()
        problem, complete = "", False
        try:
            search(len(axis.levels), partial(_level, axis, flight, store, seeds, fly), found)
            complete = True
        except TrialError as error:
            problem, whole = str(error), False
            tell(f"{axis.name}: {error}")
        finally:
            store.conclude(axis, found, complete=complete, problem=problem)
        if complete:
            tell(f"{axis.name}: {_in_words(axis, found)}")
    return whole


def _level(
    axis: Axis, flight: Flight, store: Store, seeds: Sequence[int], fly: Measure, number: int
) -> list[float]:
    level, shares = axis.levels[number], []
    for seed in seeds:
        known = store.measured(level, seed)
        measured = known or fly(flight, level.under, seed)
        if known is None:
            store.add(axis, level, seed, measured)
        shares.append(measured.share)
        tell(
            f"{axis.name}: {level.text}, seed {seed}: {100 * measured.share:.1f} % TRACKING"
            + (f" ({measured.why})" if measured.why else "")
            + (f", others used {measured.others_cores:.2f} cores" if measured.others_cores else "")
            + (", as measured before" if known else "")
        )
        if measured.share < BORNE:
            break  # it is refused, whatever the other seeds give
    return shares


def _in_words(axis: Axis, found: Found) -> str:
    text = [level.text for level in axis.levels]
    if found.sustained is None:
        return f"not even {text[0]} is sustained"
    words = f"{text[found.sustained]} is sustained"
    words += f", {text[found.refused]} is not" if found.refused is not None else ", the last level"
    if found.odd:
        words += f"; not monotonic: {', '.join(text[n] for n in found.odd)} is sustained again"
    return words


def tell(text: str) -> None:
    """A line of progress."""
    print(text, file=sys.stderr, flush=True)


def main(arguments: Sequence[str] | None = None, fly: Measure = measure) -> int:
    """Measures, writes, prints the table."""
    options = parser().parse_args(arguments)
    try:
        if options.accept:
            accept(read(options.out))
            return 0
        return _measure(options, fly)
    except (GroundStationError, ValueError) as error:
        print(f"limits: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"limits: interrupted; {options.out} has what was measured", file=sys.stderr)
        return 130


def _measure(options: Any, fly: Measure) -> int:
    axes = chosen([name for name in options.only.split(",") if name])
    seeds = QUICK_SEEDS if options.quick else SEEDS
    flight = Flight(ATRIUM / "flight.mcap", ATRIUM, QUICK_S if options.quick else WHOLE_S)
    undisturbed = QUIET_CORES if options.undisturbed else None
    store = Store(options.out, flight, seeds, undisturbed)
    machine = store.document["machine"]
    tell(
        f"{machine['cores']} cores, {machine['model']}, load {machine['load_before']:g};"
        f" a processor is held back by {method()}"
    )
    if machine["load_before"] > BUSY_LOAD:
        tell("the machine is busy: what is measured now is its limit, not the system's")
    whole = run(axes, flight, store, seeds, fly)
    table = render(store.document)
    write_text(options.out.with_suffix(".md"), table)
    print(table, end="")
    return 0 if whole else 1


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends the trial, too
    sys.exit(main())
