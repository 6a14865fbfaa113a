"""`blimp map build`: its arguments and what it prints. Heavy modules are imported when it runs."""

from __future__ import annotations

import argparse
import os
import sys
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from ground_station.errors import GroundStationError
from ground_station.files import write_json

if TYPE_CHECKING:
    from ground_station.mapping.construction.cache import Cache
    from ground_station.mapping.settings import MappingSettings

HELP = "Builds a map from recordings, videos or folders."

EXAMPLE = """\
examples:
  blimp map build flight.mcap --out maps/atrium
  blimp map build walk.mp4 --out maps/hall
  blimp map build frames/ --camera camera.toml --range 0:500:5 --out maps/kitchen
  blimp map build flight.mcap --dask 8 --pairs exhaustive --out maps/hall

A build that is started again goes on where the last one was, killed or not: features and pairs are
kept in a cache.
A Dask cluster runs what it is sent, as the user who started it: use one of your own network, with
tls:// and certificates in Dask's configuration where others share it."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of `blimp map build`."""
    parser.set_defaults(next="")  # the map says
    parser.add_argument("inputs", nargs="+", metavar="INPUT", help="recording, video or folder")
    parser.add_argument(
        "--camera", metavar="TOML",
        help="camera file (default: a recording's own, else by the metadata, else a guess)",
    )  # fmt: skip
    parser.add_argument("--out", required=True, metavar="MAP", help="folder of the map")
    parser.add_argument("--features", help="extractor or model by name (default: the settings')")
    parser.add_argument("--range", metavar="A:B[:S]", help="frames A to B, with S every S-th")
    parser.add_argument(
        "--rate-hz", type=float, help="of a folder (default: its names' times, or 30)"
    )
    parser.add_argument(
        "--max-images", type=int, metavar="N",
        help="of a longer input so many keyframes at most (default: the settings')",
    )  # fmt: skip
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
    cache.add_argument("--no-cache", action="store_true", help="keep nothing, and make all again")
    parser.add_argument(
        "--dask",
        metavar="ADDRESS|N",
        help="extract, match and make parts on a Dask cluster, tcp://HOST:PORT or tls://HOST:PORT, "
        "or in N processes here (default: threads)",
    )
    parser.add_argument("--json", metavar="FILE", help="write what was measured, too")


def run(args: argparse.Namespace) -> int:
    """Builds; raises `BlimpError` for what a person can fix."""
    from ground_station.map.folder import PICTURE, check_target
    from ground_station.map.picture import from_above
    from ground_station.map.summary import describe
    from ground_station.mapping.construction.build import build_map
    from ground_station.mapping.construction.dask_option import open_workers
    from ground_station.mapping.construction.inputs import open_inputs
    from ground_station.mapping.construction.verdict import next_step, verdict
    from ground_station.mapping.settings import load_settings, with_changes
    from ground_station.presentation.theme import LIGHT, write_png

    check_target(Path(args.out))
    changes = {
        "features": args.features,
        "max_images": args.max_images,
        "seed": args.seed,
        "match.pairs": args.pairs,
    }
    settings = with_changes(load_settings(args.settings), changes, "blimp map build")
    threads = settings.threads or os.cpu_count() or 1
    # A cluster that is not there is said before anything is read.
    with (
        open_workers(args.dask, threads, settings) as workers,
        _cache(args, settings) as cache,
    ):
        inputs = open_inputs(
            args.inputs, settings, camera=args.camera, rate_hz=args.rate_hz, frames=args.range
        )
        for line in inputs.said:
            print(line, flush=True)
        map_ = build_map(
            inputs, inputs.camera, settings, args.out,
            prior=inputs.prior, total=inputs.total, built=inputs.built, cache=cache,
            workers=workers,
        )  # fmt: skip
        if cache:
            print(f"{cache.figures} (cache {cache.folder})")
        for line in map_.info.built["notes"]:
            print(line)
    for note in inputs.notes:
        print(f"note: {note}", file=sys.stderr)
    found = verdict(map_)
    picture = Path(args.out) / PICTURE
    write_png(from_above(map_, found.missing, found.lines[0], LIGHT), picture)
    for line in found.lines:
        print(line)
    print(f"picture: {picture}")
    args.next = next_step(found, map_, args.out)
    if args.json:
        seen = {"verdict": found.word, "said": found.lines, "picture": str(picture)}
        write_json(args.json, seen | describe(map_))
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
