"""`blimp map compress`: its arguments and what it prints; heavy modules come when it runs."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ground_station.map.table import print_table

HELP = "Makes a smaller map that localizes nearly as well."

EXAMPLE = """\
examples:
  blimp map compress maps/atrium --out maps/atrium-small
  blimp map compress maps/atrium --out maps/atrium-tiny --landmarks 1000 --descriptor-bytes 16
  blimp bench map maps/atrium

The landmarks that are kept cover every keyframe, and views between and beside them, with those that
are known well and always looked the same. A descriptor of 128 numbers becomes a byte for each
stretch of them. Where landmarks and keyframes are does not change. sparse/ keeps cameras, poses and
points; the tracks, which keyframes.safetensors holds as well, only with --sights. 'blimp bench map'
measures what a size costs in accuracy."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of `blimp map compress`."""
    add = parser.add_argument
    add("map", metavar="MAP", help="folder of the map, which stays as it is")
    add("--out", required=True, metavar="NEWMAP", help="folder of the smaller one")
    add("--landmarks", type=float, default=0.5, metavar="SHARE|N",
        help="up to 1 the share that is kept, above it their number (0.5)")  # fmt: skip
    add("--descriptor-bytes", type=int, metavar="B",
        help="bytes a descriptor; 0: as they are (one for every four numbers)")  # fmt: skip
    add("--sights", action="store_true", help="the COLMAP model in sparse/ keeps its tracks")
    add("--seed", type=int, default=0, metavar="N", help="of the descriptors' words (0)")
    add("--json", metavar="FILE", help="write what came of it, too")


def run(args: argparse.Namespace) -> int:
    """Compresses; raises `BlimpError` for what a person can mend."""
    from ground_station.errors import InputError
    from ground_station.files import write_json
    from ground_station.map_update.compression.compress import Compression, compress_map

    for path in (args.out, args.json):
        if path and not Path(path).resolve().parent.is_dir():
            raise InputError(f"{path}: its folder does not exist")
    for name, value in (("--seed", args.seed), ("--descriptor-bytes", args.descriptor_bytes)):
        if value is not None and value < 0:
            raise InputError(f"{name} is {value}; 0 or more is needed")
    wanted = Compression(args.landmarks, args.descriptor_bytes, args.sights, seed=args.seed)
    _, report = compress_map(args.map, args.out, wanted)
    print_table(_shown(report))
    if args.json:
        write_json(args.json, report)
    return 0


def _shown(report: dict[str, Any]) -> dict[str, Any]:
    """The report with each number beside what it was."""
    shown: dict[str, Any] = {"method": report["method"]}
    for name in ("landmarks", "modes", "sights"):
        if before := report[f"{name}_before"]:
            shown[name] = f"{before} -> {report[name]}"
    for name, value in report["in_keyframe"].items():
        shown[f"in_keyframe {name}"] = f"{report['in_keyframe_before'][name]} -> {value}"
    for name in ("descriptor_bytes", "descriptor_error"):
        shown[name] = report.get(name)
    for part, after in report["bytes"].items():
        before = report["bytes_before"][part]
        share = f" ({after / before:.0%})" if before else ""
        shown[f"bytes {part}"] = f"{before} -> {after}{share}"
    return shown
