"""`blimp map info`: its arguments and what it prints. Heavy modules are imported when it runs."""

from __future__ import annotations

import argparse

from ground_station.files import write_json
from ground_station.map.table import print_table

HELP = "Says what a map holds, and how good it is."

EXAMPLE = """\
examples:
  blimp map info maps/atrium --json out/atrium.json
  blimp map info maps/atrium --localizability

track, angle_deg and landmark_sigma are of the landmarks, error_px of their observations, each as
its 5th, 50th and 95th percentile; lengths are in the map's units."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of `blimp map info`."""
    parser.set_defaults(next="blimp map view {map} --out map.html --open")
    parser.add_argument("map", metavar="MAP", help="folder of the map")
    parser.add_argument(
        "--localizability", action="store_true",
        help="also say in which share of places and headings too few are expected (seconds)",
    )  # fmt: skip
    parser.add_argument("--json", metavar="FILE", help="write it as JSON, too")


def run(args: argparse.Namespace) -> int:
    """Prints; raises `BlimpError` for what a person can fix."""
    from ground_station.map.store import load
    from ground_station.map.summary import describe

    map_ = load(args.map)
    document = describe(map_)
    if args.localizability:
        from ground_station.inspection.localizability import localizability, plan_of
        from ground_station.map.levelling import levelled

        document["localizability"] = localizability(levelled(map_), plan_of(map_)).summary()
    print_table(document)
    if args.json:
        write_json(args.json, document)
    return 0
