"""`blimp map view`: arguments and what it prints. Heavy modules are imported when it runs."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ground_station.files import check_outputs, write_json
from ground_station.map.table import print_table

if TYPE_CHECKING:
    from ground_station.map.store import Map

HELP = "Shows a map, and how well a camera is placed where in it, on one HTML page."

EXAMPLE = """\
examples:
  blimp map view maps/atrium --out out/atrium.html --open
  blimp map view maps/atrium --out out/atrium.html --cell-m 0.5 --headings 12 --height-m 2.5

The page needs no network and no server. Its localizability map says, for a grid of places and
headings, how many landmarks a camera is expected to find and how well they fix its pose."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of `blimp map view`."""
    parser.set_defaults(next="blimp localize VIDEO --map {map} --out est.txt")
    parser.add_argument("map", metavar="MAP", help="folder of the map")
    parser.add_argument("--out", required=True, metavar="FILE.html", help="page to write")
    parser.add_argument("--open", action="store_true", help="open it in the browser")
    parser.add_argument(
        "--cell-m", type=float, metavar="M", help="side of a cell (default: up to 600 round ones)"
    )
    parser.add_argument(
        "--height-m", type=float, metavar="M", help="of the camera (default: as the keyframes near)"
    )
    parser.add_argument(
        "--headings", type=int, default=8, metavar="N", help="at each place, 1 to 36 (default 8)"
    )
    parser.add_argument("--json", metavar="FILE", help="write what was measured, too")


def run(args: argparse.Namespace) -> int:
    """Writes the page; raises `BlimpError` for what a person can fix."""
    from ground_station.inspection import page
    from ground_station.inspection.localizability import localizability, plan_of
    from ground_station.map.levelling import levelled
    from ground_station.map.store import load

    check_outputs(args.out, args.json)
    map_ = load(args.map)
    plan, upright = plan_of(map_), levelled(map_)
    found = localizability(
        upright, plan, cell_m=args.cell_m, height_m=args.height_m, headings=args.headings
    )
    page.write(args.out, upright, plan, found)
    figures = _own_lengths(found.summary(), map_)
    print_table(figures)
    if map_.info.units != "m":
        print("lengths are in the map's own units: it has no metres before blimp map register")
        args.next = f"blimp map register {shlex.quote(args.map)} --page"
    if args.json:
        write_json(args.json, {"localizability": figures})
    print(args.out)
    if args.open:
        import webbrowser

        webbrowser.open(Path(args.out).resolve().as_uri())
    return 0


def _own_lengths(table: dict[str, Any], map_: Map) -> dict[str, Any]:
    """Figures whose names say metres only where the map has them."""
    if map_.info.units == "m":
        return table
    return {name.removesuffix("_m"): value for name, value in table.items()}
