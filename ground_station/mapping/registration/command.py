"""`blimp map register`: arguments and what it prints. Heavy modules are imported when it runs."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from ground_station.errors import MapError
from ground_station.files import write_json
from ground_station.mapping.table import print_table

HELP = "Takes a map to world coordinates."

EXAMPLE = """\
examples:
  blimp map register maps/atrium --pairs maps/atrium/PAIRS.csv
  blimp map register maps/kitchen --trajectory truth.txt

PAIRS.csv: point,image,u_px,v_px,x_m,y_m,z_m; one line for each sight of a known point, at
least two images a point and three points that are not on one line."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of `blimp map register`."""
    parser.add_argument("map", metavar="MAP", help="folder of the map")
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--pairs", metavar="CSV", help="sights of known points")
    source.add_argument("--trajectory", metavar="TUM", help="true poses at the keyframes' times")
    parser.add_argument("--seed", type=int, default=0, help="of the robust fit (default 0)")
    parser.add_argument("--json", metavar="FILE", help="write what was measured, too")


def run(args: argparse.Namespace) -> int:
    """Registers; raises `BlimpError` for what a person can mend."""
    from ground_station.geometry.trajectory import read_tum
    from ground_station.mapping.registration.register import register_map
    from ground_station.mapping.registration.sights import read_pairs

    if args.seed < 0:
        raise MapError(f"--seed is {args.seed}; allowed: 0 or more")
    sights = read_pairs(args.pairs) if args.pairs else None
    trajectory = read_tum(args.trajectory) if args.trajectory else None
    _, found = register_map(
        args.map,
        sights=sights,
        trajectory=trajectory,
        source=Path(args.pairs or args.trajectory).name,
        seed=args.seed,
    )
    for note in found.notes:
        print(f"note: {note}", file=sys.stderr)
    shown = {
        name: value
        for name, value in found.report.items()
        if name not in ("rotation", "translation_m", "point_names")
        and not name.startswith("point_")
    }
    print_table(shown)
    held = found.report.get("point_held_out_m", [])
    if held:
        rows = zip(found.report["point_names"], found.report["point_residual_m"], held, strict=True)
        print(f"\n{'point':<24} {'residual_m':>10} {'held out_m':>10}")
        for name, residual, left in rows:
            print(f"{name:<24} {residual:>10.4f} {left:>10.4f}")
    if args.json:
        write_json(args.json, found.report)
    return 0
