"""`blimp map export`: arguments and what it prints. Heavy modules are imported when it runs."""

from __future__ import annotations

import argparse

_DPI = 100  # a picture for a page of text: its file stays small

HELP = "Writes a map's landmarks for other programs, or its picture."

EXAMPLE = """\
examples:
  blimp map export maps/atrium --ply out/atrium.ply
  blimp map export maps/atrium --png out/atrium.png

The picture shows landmarks and keyframes from above, on the map's floor plan where it has one.

The PLY file opens in CloudCompare and MeshLab: a point for each landmark, with the number of its
observations, its standard deviation, viewing cone and distances. The map's own folder 'sparse' is a
COLMAP model, which COLMAP's tools open as it is."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of `blimp map export`."""
    parser.set_defaults(next="blimp map view {map} --out map.html --open")
    parser.add_argument("map", metavar="MAP", help="folder of the map")
    parser.add_argument("--ply", metavar="FILE", help="PLY file to write")
    parser.add_argument("--png", metavar="FILE", help="picture from above to write")


def run(args: argparse.Namespace) -> int:
    """Writes; raises `BlimpError` for what a person can fix."""
    from ground_station.errors import InputError
    from ground_station.map.store import load

    if not (args.ply or args.png):
        raise InputError("--ply or --png is needed: what is to be written")
    map_ = load(args.map)
    units = "metres" if map_.info.registered else "arbitrary units: the map is not registered"
    if args.ply:
        from ground_station.inspection.ply import write_ply

        write_ply(args.ply, map_)
        print(f"{args.ply}: {len(map_.landmarks)} landmarks, {units}")
    if args.png:
        from ground_station.inspection.localizability import plan_of
        from ground_station.map.picture import from_above
        from ground_station.presentation.theme import LIGHT, write_png

        title = f"{map_.info.name}: {len(map_.keyframes)} keyframes"
        plan = plan_of(map_)
        straight = plan if plan is not None and plan.origin[2] == 0 else None
        write_png(from_above(map_, (), title, LIGHT, straight), args.png, _DPI)
        print(f"{args.png}: from above, {units}")
    return 0
