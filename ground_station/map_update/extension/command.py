"""`blimp map extend`: its arguments and what it prints. Heavy modules are imported when it runs."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from ground_station.map.table import print_table
from ground_station.map_update.outputs import add_outputs, checked

HELP = "Adds flights under another light, or of another wing, to a map."

EXAMPLE = """\
examples:
  blimp map extend maps/atrium sunset.mcap
  blimp map extend maps/atrium wing.mcap --out maps/atrium-and-wing

Each input is localized in the map. New landmarks are triangulated, old ones learn how they look
otherwise, and nothing that is registered moves. The old map is kept beside the new one, as
MAP.before, until you delete it. To let poses and landmarks move, too, see 'blimp map refine'."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of `blimp map extend`."""
    parser.add_argument("map", metavar="MAP", help="folder of the map")
    parser.add_argument("inputs", nargs="+", metavar="INPUT", help="recording, video or folder")
    parser.add_argument("--camera", metavar="TOML", help="default: the input's own, else the map's")
    parser.add_argument("--range", metavar="A:B[:S]", help="frames A up to B, every S-th")
    parser.add_argument(
        "--rate-hz", type=float, help="of a folder (default: its names' times, or 30)"
    )
    add_outputs(parser)


def run(args: argparse.Namespace) -> int:
    """Extends; raises `BlimpError` for what a person can fix."""
    from ground_station.files import write_json
    from ground_station.geometry.camera import load_camera
    from ground_station.map_update.extension.extend import extend_map
    from ground_station.recording.open import parse_range

    settings = checked(args)
    _, result = extend_map(
        args.map,
        args.inputs,
        settings,
        camera=load_camera(args.camera) if args.camera else None,
        out=args.out,
        rate_hz=args.rate_hz,
        frame_range=parse_range(args.range) if args.range else None,
    )
    for note in result.notes:
        print(f"note: {note}", file=sys.stderr)
    print_table(shown(result.report))
    if result.kept is not None:
        print(f"the old map is kept in {result.kept}")
    if args.json:
        write_json(args.json, result.report)
    return 0


def shown(report: dict[str, Any]) -> dict[str, Any]:
    """The report as a table: what grew as before and after, and a line for each flight."""
    age = report["age"]
    table: dict[str, Any] = {
        name: f"{report[name][0]} -> {report[name][1]}"
        for name in ("keyframes", "landmarks", "modes", "observations", "bytes")
    }
    table |= {
        name: report[name]
        for name in ("landmarks_seen_again", "observations_as_known", "observations_unlike")
    }
    table["never_seen"] = (
        f"{age['never_seen']} of {age['expected']} landmarks that were {age['often']} times in view"
    )
    for flight in report["flights"]:
        left = ", ".join(f"{count} {why}" for why, count in flight["frames_left_out"].items())
        table[f"flight {flight['name']}"] = (
            f"{flight['frames_localized']} of {flight['frames_read']} frames localized, "
            f"{flight['frames']} of {flight['frames_tried']} joined, "
            f"{flight['frames_not_localized']} of them beside localized ones ({left or 'none'} "
            f"left out), {flight['observations']} observations"
        )
    return table
