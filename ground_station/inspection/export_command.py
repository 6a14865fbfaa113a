"""`blimp map export`: arguments and what it prints. Heavy modules are imported when it runs."""

from __future__ import annotations

import argparse

HELP = "Writes a map's landmarks for other programs."

EXAMPLE = """\
example:
  blimp map export maps/atrium --ply out/atrium.ply

The PLY file opens in CloudCompare and MeshLab: a point for each landmark, with the number of its
observations, its standard deviation, viewing cone and distances. The map's own folder 'sparse' is a
COLMAP model, which COLMAP's tools open as it is."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of `blimp map export`."""
    parser.add_argument("map", metavar="MAP", help="folder of the map")
    parser.add_argument("--ply", required=True, metavar="FILE", help="PLY file to write")


def run(args: argparse.Namespace) -> int:
    """Writes; raises `BlimpError` for what a person can mend."""
    from ground_station.inspection.ply import write_ply
    from ground_station.map.store import load

    map_ = load(args.map)
    write_ply(args.ply, map_)
    units = "metres" if map_.info.registered else "arbitrary units: the map is not registered"
    print(f"{args.ply}: {len(map_.landmarks)} landmarks, {units}")
    return 0
