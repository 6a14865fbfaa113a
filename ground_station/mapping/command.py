"""`blimp map build|register|refine|info`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ground_station.errors import CameraError, InputError, MapError
from ground_station.files import write_json
from ground_station.mapping import refine_command

if TYPE_CHECKING:
    from ground_station.geometry.camera import Camera
    from ground_station.mapping.store import Map
    from ground_station.recording.frames import Frame, FrameSource

_BUILD_EXAMPLE = """\
examples:
  blimp map build flight.mcap --out maps/atrium
  blimp map build frames/ --camera camera.toml --range 0:500:5 --out maps/kitchen"""
_REGISTER_EXAMPLE = """\
examples:
  blimp map register maps/atrium --pairs maps/atrium/PAIRS.csv
  blimp map register maps/kitchen --trajectory truth.txt

PAIRS.csv: point,image,u_px,v_px,x_m,y_m,z_m; one line for each sight of a known point, at
least two images a point and three points that are not on one line."""
_INFO_EXAMPLE = """\
example:
  blimp map info maps/atrium --json out/atrium.json"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds `build`, `register`, `refine` and `info` to the parser of `blimp map`."""
    commands = parser.add_subparsers(dest="map_command", required=True, metavar="COMMAND")

    def add(name: str, text: str, epilog: str) -> argparse.ArgumentParser:
        return commands.add_parser(
            name,
            help=text[0].lower() + text[1:].rstrip("."),
            description=text,
            epilog=epilog,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )

    build = add("build", "Builds a map from recordings, videos or folders.", _BUILD_EXAMPLE)
    build.add_argument("inputs", nargs="+", metavar="INPUT", help="recording, video or folder")
    build.add_argument("--camera", metavar="TOML", help="camera file; a recording carries its own")
    build.add_argument("--out", required=True, metavar="MAP", help="folder of the map")
    build.add_argument("--features", help="extractor or model by name (default: the settings')")
    build.add_argument("--range", metavar="A:B[:S]", help="frames A up to B, every S-th")
    build.add_argument("--rate-hz", type=float, default=30.0, help="of a folder (default 30)")
    build.add_argument("--settings", metavar="TOML", help="settings file (default: the shipped)")
    build.add_argument("--seed", type=int, help="of every random choice (default: the settings')")
    build.add_argument("--json", metavar="FILE", help="write what was measured, too")

    register = add("register", "Takes a map to world coordinates.", _REGISTER_EXAMPLE)
    register.add_argument("map", metavar="MAP", help="folder of the map")
    source = register.add_mutually_exclusive_group(required=True)
    source.add_argument("--pairs", metavar="CSV", help="sights of known points")
    source.add_argument("--trajectory", metavar="TUM", help="true poses at the keyframes' times")
    register.add_argument("--seed", type=int, default=0, help="of the robust fit (default 0)")
    register.add_argument("--json", metavar="FILE", help="write what was measured, too")

    refine_command.add_arguments(add("refine", refine_command.HELP, refine_command.EXAMPLE))

    info = add("info", "Says what a map holds.", _INFO_EXAMPLE)
    info.add_argument("map", metavar="MAP", help="folder of the map")
    info.add_argument("--json", metavar="FILE", help="write it as JSON, too")


def run(args: argparse.Namespace) -> int:
    """Runs the subcommand; raises `BlimpError` for what a person can mend."""
    if args.map_command == "refine":
        return refine_command.run(args, _print_table)
    return {"build": _build, "register": _register, "info": _info}[args.map_command](args)


def _build(args: argparse.Namespace) -> int:
    import dataclasses

    from ground_station.geometry.camera import load_camera
    from ground_station.mapping.build import build_map
    from ground_station.mapping.folder import check_target
    from ground_station.mapping.refine import straighten
    from ground_station.mapping.settings import MappingSettings, load_settings
    from ground_station.recording.open import parse_range
    from pi_firmware.wire import config

    check_target(Path(args.out))
    settings = load_settings(args.settings)
    changes = {"features": args.features, "seed": args.seed}
    changes = {name: value for name, value in changes.items() if value is not None}
    # Through the same checks as the file.
    settings = config.from_mapping(
        dataclasses.asdict(settings) | changes, MappingSettings, where="blimp map build"
    )
    wanted = parse_range(args.range) if args.range else None
    sources, step, total = _open(args, wanted, settings.max_images)
    camera = load_camera(args.camera) if args.camera else _carried(args.inputs, sources)
    built: dict[str, Any] = {
        "inputs": [Path(path).name for path in args.inputs],
        "range": args.range or f"::{step}",
        "rate_hz": args.rate_hz,
    }
    build_map(_named(args.inputs, sources), camera, settings, args.out, total=total, built=built)
    map_ = straighten(args.out, settings)
    for source in sources:
        for note in source.notes:
            print(f"note: {note}", file=sys.stderr)
    _print_table(_describe(map_))
    if args.json:
        write_json(args.json, _describe(map_))
    return 0


def _open(
    args: argparse.Namespace, wanted: Any, max_images: int
) -> tuple[list[FrameSource], int, int | None]:
    """The inputs, thinned evenly to `max_images` where the range gives no step; step, frames."""
    import dataclasses

    from ground_station.recording.frames import ALL_FRAMES
    from ground_station.recording.open import open_input

    sources = [open_input(path, args.rate_hz, wanted) for path in args.inputs]
    counts = [source.count() for source in sources]
    if args.range and args.range.count(":") == 2:
        known = [count for count in counts if count is not None]
        return sources, wanted.step, sum(known) if len(known) == len(counts) else None
    # A container that does not say how many frames it holds is read once more.
    total = sum(
        sum(1 for _ in source) if count is None else count
        for source, count in zip(sources, counts, strict=True)
    )
    step = max(1, -(-total // max_images))
    if step > 1:
        thinned = dataclasses.replace(wanted or ALL_FRAMES, step=step)
        sources = [open_input(path, args.rate_hz, thinned) for path in args.inputs]
        print(f"{total} frames; one in {step} is used (max_images is {max_images})")
    return sources, step, -(-total // step)


def _carried(paths: list[str], sources: list[FrameSource]) -> Camera:
    cameras = [source.camera for source in sources]
    for path, camera in zip(paths, cameras, strict=True):
        if camera is None:
            raise CameraError(f"{path}: does not carry a camera; give one with --camera")
        if camera != cameras[0]:
            raise CameraError(f"{path}: was taken by another camera than {paths[0]}")
    assert cameras[0] is not None  # the loop has seen it
    return cameras[0]


def _named(paths: list[str], sources: list[FrameSource]) -> Iterator[Frame]:
    """All frames in order; of several inputs, names begin with the input's."""
    import dataclasses

    stems = [Path(path).resolve().stem for path in paths]
    if len(set(stems)) != len(stems):
        twice = next(stem for stem in stems if stems.count(stem) > 1)
        raise InputError(f"two inputs are named '{twice}'; images are told apart by that name")
    for stem, source in zip(stems, sources, strict=True):
        for frame in source:
            if len(paths) == 1:
                yield frame
            else:
                yield dataclasses.replace(frame, name=f"{stem}/{frame.name}")


def _register(args: argparse.Namespace) -> int:
    from ground_station.geometry.trajectory import read_tum
    from ground_station.mapping.register import register_map
    from ground_station.mapping.sights import read_pairs

    if args.seed < 0:
        raise MapError(f"--seed is {args.seed}; allowed: 0 or more")
    sights = read_pairs(args.pairs) if args.pairs else None
    trajectory = read_tum(args.trajectory) if args.trajectory else None
    _, found = register_map(
        args.map,
        sights=sights,
        trajectory=trajectory,
        source=Path(args.pairs or args.trajectory).name,
        seed=args.seed,
    )
    for note in found.notes:
        print(f"note: {note}", file=sys.stderr)
    shown = {
        name: value
        for name, value in found.report.items()
        if name not in ("rotation", "translation_m", "point_names")
        and not name.startswith("point_")
    }
    _print_table(shown)
    held = found.report.get("point_held_out_m", [])
    if held:
        rows = zip(found.report["point_names"], found.report["point_residual_m"], held, strict=True)
        print(f"\n{'point':<24} {'residual_m':>10} {'held out_m':>10}")
        for name, residual, left in rows:
            print(f"{name:<24} {residual:>10.4f} {left:>10.4f}")
    if args.json:
        write_json(args.json, found.report)
    return 0


def _info(args: argparse.Namespace) -> int:
    from ground_station.mapping.store import load

    document = _describe(load(args.map))
    _print_table(document)
    if args.json:
        write_json(args.json, document)
    return 0


def _describe(map_: Map) -> dict[str, Any]:
    """What `info` says, as plain values."""
    from ground_station.mapping.refined import Refined

    info, lm, kf = map_.info, map_.landmarks, map_.keyframes
    camera, built = info.camera, info.built
    folder = map_.folder
    size = sum(p.stat().st_size for p in folder.rglob("*") if p.is_file()) if folder else 0
    registration, flights = info.registration, Refined.of(map_).flights
    return {
        "name": info.name,
        "frame": info.frame,
        "units": info.units,
        "images": len(kf),
        "images_given": built.get("images", len(kf)),
        "model_sizes": built.get("model_sizes", [len(kf)]),
        "landmarks": len(lm),
        "mean_track": round(float(lm.observations.mean()), 2) if len(lm) else 0.0,
        "reprojection_px": round(float(built.get("reprojection_px", float("nan"))), 3),
        "features": info.features,
        "features_sha256": info.features_sha256,
        "camera": (
            f"{camera.model} {camera.width_px}x{camera.height_px} "
            f"f {camera.fx_px:.2f} {camera.fy_px:.2f} c {camera.cx_px:.2f} {camera.cy_px:.2f}"
        ),
        "registration": registration.get("method", "none"),
        "residual_rms_m": registration.get("residual_rms_m"),
        "held_out_rms_m": registration.get("held_out_rms_m"),
        "refined": [f"{flight['name']} ({flight['frames']} frames)" for flight in flights],
        "seed": built.get("settings", {}).get("seed"),
        "stage_s": built.get("stage_s", {}),
        "size_mb": round(size / 1e6, 2),
    }


def _print_table(document: dict[str, Any]) -> None:
    for name, value in document.items():
        if value is None or value == {} or value == []:
            continue
        if isinstance(value, float):
            value = f"{value:.6g}"
        elif isinstance(value, dict):
            value = ", ".join(f"{key} {number}" for key, number in value.items())
        elif isinstance(value, list):
            value = ", ".join(map(str, value))
        print(f"{name:<28} {value}")
