"""`blimp bench features`: all extractors on known homographies, and their time."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ground_station.presentation.text import columns

if TYPE_CHECKING:
    from ground_station.arrays import U8
    from ground_station.features.extractor import Extractor

Rows = dict[str, dict[str, Any]]
"""By an extractor: its name, hash and dimension, and where measured `homographies` and `time`."""
KINDS = ("homographies", "times")
_NONE = "-"

HELP = "extractors on known homographies"
DESCRIPTION = "Measures all extractors: how often points are found again and matched, time."
EPILOG = """\
examples:
  blimp bench features --json out/features.json
  blimp bench features --only homographies times --extractors rootsift orb

homographies: DATA/illumination, pictures in the Oxford layout (NAME1.png, NAME2.png, NAME.H1to2p).
How well maps of them are localized in: blimp experiments illumination redkitchen --features NAME.
Times are of one run on one machine; those of two machines do not compare."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    add = parser.add_argument
    add("--data", type=Path, default=Path("../shared/data"), metavar="DIR",
        help="folder of illumination/, and of redkitchen/ for times (../shared/data)")  # fmt: skip
    add("--extractors", nargs="+", metavar="NAME", help="default: all there are")
    add("--only", nargs="+", choices=KINDS, metavar="WHAT",
        help=f"some of {', '.join(KINDS)} (default: all)")  # fmt: skip
    add("--quick", action="store_true", help="three repetitions: to see that all works")
    add("--max-features", type=int, default=1000, metavar="N", help="of a picture (1000)")
    add("--threads", type=int, default=0, metavar="N", help="of a network (0: one a core)")
    add("--repetitions", type=int, default=15, metavar="N", help="of each time (15)")
    add("--json", type=Path, metavar="F", help="write the figures, too")


def run(args: argparse.Namespace) -> int:
    """Measures, prints the table; raises `BlimpError` for what a person can fix.

    What has no data is left out with a line that names it; asked for by `--only`, it is an error.
    """
    from ground_station.bench.machine import machine
    from ground_station.errors import InputError, check_options
    from ground_station.features import extractors
    from ground_station.files import write_json

    check_options(args, max_features=(50, 20000), threads=(0, 64), repetitions=(3, 10000))
    threads = args.threads or machine()["cores"]
    made = {
        name: extractors.create(name, args.max_features, threads=threads)
        for name in dict.fromkeys(args.extractors or extractors.names())
    }
    rows: Rows = {
        name: {"name": name, "sha256": extractor.sha256, "dimension": extractor.dimension}
        for name, extractor in made.items()
    }
    measured = 0
    for kind in args.only or KINDS:
        try:
            _MEASURE[kind](args, made, rows)
            measured += 1
        except InputError as error:
            if args.only:
                raise
            print(f"blimp bench: {kind} left out: {error}", file=sys.stderr, flush=True)
    if not measured:
        raise InputError(f"{args.data}: there is nothing to measure with")
    result = {
        "machine": machine(),
        "threads": threads,
        "max_features": args.max_features,
        "quick": args.quick,
        "extractors": rows,
    }
    cores = result["machine"]["cores"]
    print(f"{cores} cores, {threads} threads a network, {args.max_features} features a picture"
          + (", quick: times of three repetitions" if args.quick else ""))  # fmt: skip
    print("\n".join(["", *table(rows)]))
    if args.json:
        write_json(args.json, result)
    return 0


def _homographies(args: argparse.Namespace, made: dict[str, Extractor], rows: Rows) -> None:
    from ground_station.bench.features import homographies
    from ground_station.progress import Progress

    pairs = homographies.read_pairs(args.data / "illumination")
    with Progress("homographies, extractors", len(made)) as progress:
        for name, extractor in made.items():
            scores = homographies.measure(extractor, pairs)
            rows[name]["homographies"] = homographies.summary(scores)
            progress.step()


def _times(args: argparse.Namespace, made: dict[str, Extractor], rows: Rows) -> None:
    from ground_station.recording.folder import read_grey

    frames = args.data / "redkitchen" / "frames"
    real = sorted(frames.iterdir())[:1] if frames.is_dir() else []
    image = read_grey(real[0]) if real else picture(0)
    for name, found in times(made, image, 3 if args.quick else args.repetitions).items():
        rows[name]["time"] = found


def times(made: dict[str, Extractor], image: U8, repetitions: int) -> Rows:
    """By name: the median time of `image`, ms, and its ratio to RootSIFT's where that is there.

    They take turns, so that a busy moment of the machine slows all.
    """
    from ground_station.bench.steps import medians_ms

    calls = [partial(extractor.extract, image) for extractor in made.values()]
    by_name = dict(zip(made, medians_ms(repetitions, *calls), strict=True))
    beside = by_name.get("rootsift")
    return {
        name: {"ms": ms, "ratio": ms / beside if beside else None} for name, ms in by_name.items()
    }


def picture(seed: int) -> U8:
    """A picture (480, 640) with texture at all scales, for when there is no real one."""
    import cv2
    import numpy as np

    rng = np.random.default_rng(seed)
    whole = np.zeros((480, 640), np.float32)
    for scale in (4, 16, 64, 160):
        small = rng.normal(size=(480 // scale + 1, 640 // scale + 1)).astype(np.float32)
        whole += scale**0.5 * cv2.resize(small, (640, 480), interpolation=cv2.INTER_CUBIC)
    whole = 128 + 40 * whole / whole.std()
    return np.asarray(whole.clip(0, 255), np.uint8)


_MEASURE: dict[str, Callable[..., None]] = {"homographies": _homographies, "times": _times}


def table(rows: Rows) -> list[str]:
    """Lines of the table: one row an extractor, a column only where some extractor has a figure."""
    scenes = dict.fromkeys(
        scene for row in rows.values() for scene in row.get("homographies", {}).get("scenes", {})
    )
    head = ["features", "numbers", "repeated", "correct at 3 px", *scenes, "homography 1, 3, 5 px",
            "ms", "of RootSIFT's"]  # fmt: skip
    lines = [head]
    for row in rows.values():
        found, time = row.get("homographies", {}), row.get("time", {})
        by_scene = [found.get("scenes", {}).get(scene) for scene in scenes]
        shares = [found.get("repeatability"), found.get("accuracy"), *by_scene]
        near = ", ".join(f"{100 * share:.0f}" for share in found.get("homography", {}).values())
        lines.append(
            [
                str(row["name"]),
                str(row["dimension"]),
                *(_cell(share, ".1%").replace("%", " %") for share in shares),
                f"{near} %" if near else _NONE,
                _cell(time.get("ms"), ".1f"),
                _cell(time.get("ratio"), ".2f"),
            ]
        )
    used = [k for k in range(len(head)) if any(line[k] != _NONE for line in lines[1:])]
    return columns([[line[k] for k in used] for line in lines])


def _cell(value: float | None, form: str) -> str:
    return _NONE if value is None or not math.isfinite(value) else format(value, form)
