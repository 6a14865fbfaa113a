"""`blimp map view`: arguments and what it prints. Heavy modules are imported when it runs."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ground_station.files import write_json
from ground_station.map.table import print_table

if TYPE_CHECKING:
    from ground_station.geometry.trajectory import Trajectory
    from ground_station.map.store import Map

HELP = "Shows a map, and how well a camera is placed where in it, on one HTML page."

EXAMPLE = """\
examples:
  blimp map view maps/atrium --out out/atrium.html --open
  blimp map view maps/atrium --out out/atrium.html --cell-m 0.5 --headings 12 --height-m 2.5
  blimp map view maps/atrium --out out/flight.html --compare est.txt truth.txt --json out/rank.json

The page needs no network and no server. Its localizability map says, for a grid of places and
headings, how many landmarks a camera is expected to find and how well they fix its pose.
--compare EST TRUTH also draws a flight and says how well prediction and error agree in rank."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of `blimp map view`."""
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
    parser.add_argument(
        "--compare", nargs=2, metavar=("EST", "TRUTH"),
        help="a flight: its estimated poses and a true one for each frame; TUM text, or recordings",
    )  # fmt: skip
    parser.add_argument("--json", metavar="FILE", help="write what was measured, too")


def run(args: argparse.Namespace) -> int:
    """Writes the page; raises `BlimpError` for what a person can fix."""
    from ground_station.errors import InputError
    from ground_station.inspection import page
    from ground_station.inspection.comparison import compare
    from ground_station.inspection.localizability import localizability, plan_of
    from ground_station.map.levelling import levelled
    from ground_station.map.store import load

    for out in (args.out, args.json):
        if out and not Path(out).resolve().parent.is_dir():
            raise InputError(f"{out}: its folder does not exist")
    map_ = load(args.map)
    plan, upright = plan_of(map_), levelled(map_)
    found = localizability(
        upright, plan, cell_m=args.cell_m, height_m=args.height_m, headings=args.headings
    )
    compared = None
    if args.compare:
        estimate, truth = (_trajectory(Path(p), k == 1) for k, p in enumerate(args.compare))
        compared = compare(map_, estimate, truth)
    page.write(args.out, upright, plan, found, compared)
    document = {"localizability": found.summary()}
    if compared is not None:
        document["compared"] = compared.summary()
    document = {name: _own_lengths(table, map_) for name, table in document.items()}
    print_table(document["localizability"] | document.get("compared", {}))
    if map_.info.units != "m":
        print("lengths are in the map's own units: it has no metres before blimp map register")
    if args.json:
        write_json(args.json, document)
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


def _trajectory(path: Path, is_truth: bool) -> Trajectory:
    from ground_station.geometry.trajectory import read_tum
    from ground_station.recording.flight import trajectory_of
    from pi_firmware.wire.recording import ESTIMATE_TOPIC, TRUTH_TOPIC

    if path.suffix.lower() != ".mcap":
        return read_tum(path)
    return trajectory_of(path, TRUTH_TOPIC if is_truth else ESTIMATE_TOPIC)
