"""`blimp map build`: its arguments and what it prints. Heavy modules are imported when it runs."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ground_station.errors import CameraError, GroundStationError, InputError
from ground_station.files import write_json
from ground_station.mapping.table import print_table

if TYPE_CHECKING:
    from ground_station.geometry.camera import Camera
    from ground_station.mapping.construction.cache import Cache
    from ground_station.mapping.settings import MappingSettings
    from ground_station.recording.frames import Frame, FrameSource


HELP = "Builds a map from recordings, videos or folders."

EXAMPLE = """\
examples:
  blimp map build flight.mcap --out maps/atrium
  blimp map build frames/ --camera camera.toml --range 0:500:5 --out maps/kitchen
  blimp map build flight.mcap --dask 8 --pairs exhaustive --out maps/hall

A build that is started again goes on where the last one was, killed or not: features and pairs are
kept in a cache.
A Dask cluster runs what it is sent, as the user who started it: use one of your own network, with
tls:// and certificates in Dask's configuration where others share it."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of `blimp map build`."""
    parser.add_argument("inputs", nargs="+", metavar="INPUT", help="recording, video or folder")
    parser.add_argument("--camera", metavar="TOML", help="camera file; a recording carries its own")
    parser.add_argument("--out", required=True, metavar="MAP", help="folder of the map")
    parser.add_argument("--features", help="extractor or model by name (default: the settings')")
    parser.add_argument("--range", metavar="A:B[:S]", help="frames A up to B, every S-th")
    parser.add_argument("--rate-hz", type=float, default=30.0, help="of a folder (default 30)")
    parser.add_argument("--settings", metavar="TOML", help="settings file (default: the shipped)")
    parser.add_argument("--seed", type=int, help="of every random choice (default: the settings')")
    parser.add_argument(
        "--pairs",
        choices=("auto", "exhaustive"),
        help="images to compare: those likely to overlap, or all (default: the settings')",
    )
    cache = parser.add_mutually_exclusive_group()
    cache.add_argument(
        "--cache",
        metavar="DIR",
        help="keep features and pairs there "
        "(default: $BLIMP_CACHE, else $XDG_CACHE_HOME/blimp/mapping)",
    )
    cache.add_argument("--no-cache", action="store_true", help="keep nothing, and make all anew")
    parser.add_argument(
        "--dask",
        metavar="ADDRESS|N",
        help="extract and match on a Dask cluster, tcp://HOST:PORT or tls://HOST:PORT, "
        "or in N processes here (default: threads)",
    )
    parser.add_argument("--json", metavar="FILE", help="write what was measured, too")


def run(args: argparse.Namespace) -> int:
    """Builds; raises `BlimpError` for what a person can mend."""
    import dataclasses

    from ground_station.geometry.camera import load_camera
    from ground_station.mapping.construction.build import build_map
    from ground_station.mapping.construction.workers import open_workers
    from ground_station.mapping.folder import check_target
    from ground_station.mapping.inspection.summary import describe
    from ground_station.mapping.refinement.refine import straighten
    from ground_station.mapping.settings import MappingSettings, load_settings
    from ground_station.recording.open import parse_range
    from pi_firmware.wire import config

    check_target(Path(args.out))
    settings = load_settings(args.settings)
    changes = {"features": args.features, "seed": args.seed}
    changes = {name: value for name, value in changes.items() if value is not None}
    # Through the same checks as the file.
    document = dataclasses.asdict(settings) | changes
    if args.pairs:
        document["match"]["pairs"] = args.pairs
    settings = config.from_mapping(document, MappingSettings, where="blimp map build")
    wanted = parse_range(args.range) if args.range else None
    threads = settings.threads or os.cpu_count() or 1
    # A cluster that is not there is said before anything is read.
    with open_workers(args.dask, threads, settings) as workers, _cache(args, settings) as cache:
        sources, step, total = _open(args, wanted, settings.max_images)
        camera = load_camera(args.camera) if args.camera else _carried(args.inputs, sources)
        built: dict[str, Any] = {
            "inputs": [Path(path).name for path in args.inputs],
            "range": args.range or f"::{step}",
            "rate_hz": args.rate_hz,
        }
        build_map(
            _named(args.inputs, sources), camera, settings, args.out,
            total=total, built=built, cache=cache, workers=workers,
        )  # fmt: skip
    map_ = straighten(args.out, settings)
    for source in sources:
        for note in source.notes:
            print(f"note: {note}", file=sys.stderr)
    print_table(describe(map_))
    if args.json:
        write_json(args.json, describe(map_))
    return 0


def _cache(
    args: argparse.Namespace, settings: MappingSettings
) -> AbstractContextManager[Cache | None]:
    """What earlier builds have made, where it is wanted."""
    from ground_station.mapping.construction.cache import Cache, default_folder

    if args.no_cache or not settings.cache_gb:
        return nullcontext()
    try:
        folder = args.cache or default_folder()
    except GroundStationError as error:
        print(f"note: nothing is kept for another build: {error}", file=sys.stderr)
        return nullcontext()
    return Cache(folder, int(settings.cache_gb * 1e9))


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
