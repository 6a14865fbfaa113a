"""`blimp map refine`: its arguments and what it prints. Heavy modules are imported when it runs."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING, Any

from ground_station.map.table import print_table
from ground_station.map_update.outputs import add_outputs, checked

if TYPE_CHECKING:
    from ground_station.arrays import F64
    from ground_station.map_update.missing import Area

HELP = "Adds what flights saw to a map, and adjusts it."

EXAMPLE = """\
example:
  blimp localize flight.mcap --map maps/atrium --out out/est.txt \\
    --observations out/flight.observations.safetensors
  blimp map refine maps/atrium out/flight.observations.safetensors
  blimp map register maps/atrium --pairs maps/atrium/PAIRS.csv

Poses and landmarks move together until all observations fit best; the map stays where it is
registered, and registering it again with the same points takes it nearer still. The old map is kept
beside the new one, as MAP.before, until you delete it. Without EST the map's own observations are
adjusted again, with the rolling shutter taken out. Places whose landmarks the flights should have
seen and never did are named: what was there was moved or is lit otherwise, or is hidden now."""

_MOST_AREAS = 10


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of `blimp map refine`."""
    parser.add_argument("map", metavar="MAP", help="folder of the map")
    parser.add_argument(
        "observations",
        nargs="*",
        metavar="EST",
        help="what 'blimp localize --observations' wrote, one file a flight",
    )
    add_outputs(parser)


def run(args: argparse.Namespace) -> int:
    """Refines; raises `BlimpError` for what a person can fix."""
    from ground_station.files import write_json
    from ground_station.map import store
    from ground_station.map.observations import load_observations
    from ground_station.map_update.missing import missing_areas
    from ground_station.mapping.refinement.refine import refine_map

    settings = checked(args)
    flights = [load_observations(path) for path in args.observations]
    before = store.load(args.map)
    refined, result = refine_map(args.map, flights, settings, args.out)
    areas = missing_areas(before, flights, settings.extend.expected_often)
    report = result.report | {"missing": [_plain(area) for area in areas]}
    print_table(_shown(result.report))
    unit = "metres" if before.info.registered else "the map's units"
    if areas:
        print(
            f"often in view and never seen, places in {unit} (moved, lit otherwise, or hidden now):"
        )
    for area in areas[:_MOST_AREAS]:
        print(
            f"  {area.missing} of {area.expected} landmarks about ({_point(area.middle_m)}), "
            f"{_point(area.size_m, ' x ')}"
        )
    if result.kept is not None:
        print(f"the old map is kept in {result.kept}")
    method = refined.info.registration.get("method")
    if method:
        print(f"registered by {method} as before; registering again uses what was gained")
    if not report["rolling_shutter"]["undone"]:
        print(
            "note: the keyframes' rolling shutter is still in the map: "
            "they are too far apart in time, or fit worse without it",
            file=sys.stderr,
        )
    if args.json:
        write_json(args.json, report)
    return 0


def _plain(area: Area) -> dict[str, Any]:
    return {
        "middle_m": area.middle_m.tolist(),
        "size_m": area.size_m.tolist(),
        "expected": area.expected,
        "missing": area.missing,
    }


def _point(values: F64, between: str = ", ") -> str:
    return between.join(f"{value:.1f}" for value in values)


def _shown(report: dict[str, Any]) -> dict[str, Any]:
    """The report with a line for each flight and none for what is empty."""
    shown = {k: v for k, v in report.items() if k not in ("flights", "keyframes")}
    shown |= {f"keyframes_{name}": value for name, value in report["keyframes"].items()}
    for flight in report["flights"]:
        left = ", ".join(f"{n} {why}" for why, n in flight["frames_left_out"].items())
        shown[f"flight {flight['name']}"] = (
            f"{flight['frames']} frames ({left or 'none'} left out), "
            f"{flight['observations']} observations, "
            f"median {flight['median_before_px']:.3f} -> {flight['median_px']:.3f} px"
        )
    return shown
