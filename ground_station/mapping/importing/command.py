"""`blimp map import`: its arguments and what it prints. Heavy modules are imported when it runs."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from ground_station.files import write_json
from ground_station.map.table import print_table

HELP = "Makes a map of a COLMAP model and its pictures."

EXAMPLE = """\
examples:
  blimp map import sparse/0 --images images/ --out maps/hall
  blimp map import outputs/sfm --images walk.mcap --features superpoint --out maps/hall

MODEL is a folder with cameras, images and points3D, binary or text, from COLMAP or hloc, whatever
its features were. Poses and camera are taken over; landmarks are made again of the pictures. The
map is in the model's coordinates, which have no units: blimp map register follows."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of `blimp map import`."""
    parser.set_defaults(next="blimp map view {out} --out map.html --open")
    parser.add_argument("model", metavar="MODEL", help="folder of the COLMAP model")
    parser.add_argument(
        "--images", required=True, metavar="INPUT",
        help="folder that the model's image names are in, or the recording or video",
    )  # fmt: skip
    parser.add_argument("--out", required=True, metavar="MAP", help="folder of the map")
    parser.add_argument("--features", help="extractor or model by name (default: the settings')")
    parser.add_argument(
        "--camera", metavar="TOML",
        help="of the pictures, where the model is of undistorted ones (default: the model's)",
    )  # fmt: skip
    parser.add_argument("--rate-hz", type=float, default=30.0, help="of a folder (default 30)")
    parser.add_argument("--settings", metavar="TOML", help="settings file (default: the shipped)")
    parser.add_argument("--seed", type=int, help="of every random choice (default: the settings')")
    parser.add_argument("--json", metavar="FILE", help="write what was measured, too")


def run(args: argparse.Namespace) -> int:
    """Imports; raises `BlimpError` for what a person can fix."""
    from ground_station.geometry.camera import load_camera
    from ground_station.map.folder import check_target
    from ground_station.map.summary import describe
    from ground_station.mapping.importing.build import import_model
    from ground_station.mapping.importing.pictures import open_pictures, taken_by
    from ground_station.mapping.settings import load_settings, with_changes
    from ground_station.mapping.sfm.foreign import read

    check_target(Path(args.out))
    changes = {"features": args.features, "seed": args.seed}
    settings = with_changes(load_settings(args.settings), changes, "blimp map import")
    model = read(args.model)
    pictures = open_pictures(args.images, model.names, args.rate_hz)
    camera = load_camera(args.camera) if args.camera else model.camera
    if not args.camera and pictures.camera is not None:
        camera, note = taken_by(model.camera, pictures.camera)
        if note:
            print(f"note: {args.images}: {note}; --camera takes another", file=sys.stderr)
    built: dict[str, Any] = {
        "source": "COLMAP model",
        "model": Path(args.model).resolve().name,
        "inputs": [Path(args.images).name],
        "range": "::",
        "rate_hz": args.rate_hz,
    }
    map_ = import_model(model, pictures, camera, settings, args.out, built=built)
    for note in map_.info.built["notes"]:
        print(note)
    for note in pictures.notes:
        print(f"note: {note}", file=sys.stderr)
    print_table(describe(map_))
    if args.json:
        write_json(args.json, describe(map_))
    return 0
