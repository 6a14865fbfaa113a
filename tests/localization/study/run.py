"""What the localizer says when it is lost, as its README tells: run by hand, not by pytest.

    python tests/localization/study/run.py all --flights out/study/loop-*.mcap \\
        --others out/reloc/office-*.mcap --json out/study.json
    python tests/localization/study/run.py kidnapping --flights out/fast5.mcap --limit 200

Flights are recordings of `blimp simulate`, which hold their truth and seed; other buildings may
also be `FOLDER@CAMERA.toml`. Each row prints its bound, its figure and the seeds of its flights.
What it costs is in `blimp bench localize`; errors, their covariance and the thesis's way beside it
are in `blimp experiments`.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

# As the blimp command does, before numpy is imported: small products gain nothing by threads.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from study import recovering
from study.row import Line, Row, Study

from ground_station.bench.machine import machine
from ground_station.errors import GroundStationError
from ground_station.files import write_json
from ground_station.localization.settings import LocalizerSettings, load_preset
from ground_station.map.store import load
from pi_firmware.wire import config
from pi_firmware.wire.errors import BlimpError

ROWS = {
    "kidnapping": recovering.kidnapping,
    "others": recovering.other_buildings,
}
NEEDS = {"kidnapping": "flights", "others": "others"}
"""What flights of the user's a row cannot be run without."""


def parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("rows", nargs="+", metavar="ROW", choices=["all", *ROWS],
                   help=f"all, or of {', '.join(ROWS)}")  # fmt: skip
    p.add_argument("--map", default="maps/atrium", help="the flights' map (maps/atrium)")
    p.add_argument("--flights", nargs="*", default=[], help="flights to jump between")
    p.add_argument("--others", nargs="*", default=[], help="flights of other buildings")
    p.add_argument("--settings", metavar="FILE.toml", help="instead of the preset default")
    p.add_argument("--limit", type=int, help="most frames of a flight, for a quick look")
    p.add_argument("--jumps", type=int, default=200, help="kidnappings (200)")
    p.add_argument("--count", type=int, default=1000, help="frames asked on their own (1000)")
    p.add_argument("--seed", type=int, default=0, help="of the places that are drawn (0)")
    p.add_argument("--cores", type=int, default=2, help="processor cores it may use (2)")
    p.add_argument("--json", metavar="F", help="write everything measured to this file")
    return p


def table(lines: list[Line], title: str = "") -> str:
    """Lines as text, each in two: what and its bound, then the figure and the seeds."""
    marks = {True: "met   ", False: "MISSED", None: "      "}
    text = [title] if title else []
    for line in lines:
        text.append(f"{marks[line.met]} {line.what:44s} {line.bound}".rstrip())
        text.append(f"         {line.figure}")
        text.append(f"         [{line.seeds}]")
    return "\n".join(text)


def study_of(args: argparse.Namespace) -> Study:
    """What the arguments ask for; raises the program's own errors with one line."""
    settings = (
        config.load(args.settings, LocalizerSettings) if args.settings else load_preset("default")
    )
    return Study(
        map_=load(args.map),
        settings=settings,
        flights=args.flights,
        others=args.others,
        limit=args.limit,
        jumps=args.jumps,
        count=args.count,
        seed=args.seed,
    )


def run(args: argparse.Namespace) -> int:
    """Runs the rows that are asked for; 0, or 2 with one line of what cannot be."""
    rows = list(ROWS) if "all" in args.rows else list(dict.fromkeys(args.rows))
    for name in rows:
        if name in NEEDS and not getattr(args, NEEDS[name]):
            print(f"study: the row '{name}' needs --{NEEDS[name]}", file=sys.stderr)
            return 2
    result: dict[str, Any] = {"machine": machine(), "seed": args.seed}
    try:
        study = study_of(args)
        result |= {"map": args.map, "settings": asdict(study.settings), "rows": {}}
        for name in rows:
            begin = time.monotonic()
            row: Row = ROWS[name](study)
            took_s = time.monotonic() - begin
            print(table(row.lines), flush=True)
            lines = [asdict(line) for line in row.lines]
            result["rows"][name] = {"lines": lines, "took_s": took_s, "data": row.data}
            if args.json:  # after every row: an interrupted study keeps what it has
                write_json(args.json, result)
    except (GroundStationError, BlimpError) as error:
        print(f"study: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    arguments = parser().parse_args()
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: max(1, arguments.cores)])
    sys.exit(run(arguments))
