"""`blimp import`: a plain video as a recording."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path

_EPILOG = """\
examples:
  blimp import walk.mp4 --camera camera.toml --out walk.mcap
  blimp import pictures/ --rate-hz 10 --camera camera.toml --out walk.mcap
  blimp replay walk.mcap --map maps/hall        # through the payload's firmware

A recording carries its camera, which `blimp calibrate` finds. Frames keep their times; they are
encoded again, in grey, as the payload would. `blimp map build` and `blimp localize` take videos as
they are."""

_MOST_PX = (1920, 1088)
"""What the payload's firmware takes: camera.width_px and camera.height_px of payload.toml."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.epilog = _EPILOG
    parser.set_defaults(next="blimp replay {out} --map maps/NAME")
    parser.add_argument("input", metavar="INPUT", help="video file or folder of images")
    parser.add_argument("--camera", required=True, metavar="CAMERA.toml", help="its calibration")
    parser.add_argument("--out", type=Path, required=True, metavar="F.mcap", help="what to write")
    parser.add_argument("--range", metavar="A:B[:S]", help="frames A to B-1, every S-th")
    parser.add_argument(
        "--rate-hz",
        type=float,
        metavar="R",
        help="of a folder of images (times that they are named by, or 30)",
    )


def run(args: argparse.Namespace) -> int:
    """Writes the recording; raises `BlimpError` with one line."""
    from ground_station.errors import InputError
    from ground_station.files import check_outputs
    from ground_station.geometry.camera import load_camera
    from ground_station.geometry.resizing import for_pictures
    from ground_station.progress import Progress
    from ground_station.recording.flight import FlightRecording
    from ground_station.recording.importing import import_frames
    from ground_station.recording.look import look
    from ground_station.recording.open import open_input, parse_range

    check_outputs(args.out)
    source = open_input(args.input, args.rate_hz, parse_range(args.range) if args.range else None)
    if isinstance(source, FlightRecording):
        raise InputError(f"{args.input}: is a recording already: blimp replay {args.input}")
    first = look(source)
    camera, said = for_pictures(
        load_camera(args.camera), first.size_px, first.display_deg, str(args.input)
    )
    if said:
        _log(said)
    with Progress("import", source.count()) as progress:
        frames = import_frames(source, camera, args.out, name=args.input, step=progress.step)
    for note in source.notes:
        _log(note)
    print(f"{frames} frames of {camera.width_px}x{camera.height_px} -> {args.out}")
    if camera.width_px > _MOST_PX[0] or camera.height_px > _MOST_PX[1]:
        most = "x".join(map(str, _MOST_PX))
        _log(f"the payload's firmware takes {most} at most: to replay it, import a smaller video")
        args.next = f"blimp map build {shlex.quote(str(args.out))} --out maps/NAME"
    return 0


def _log(text: str) -> None:
    print(f"blimp import: {text}", file=sys.stderr)
