"""`blimp bench features`: all extractors on known homographies, real poses, simulated flights."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ground_station.features.extractor import Extractor
    from ground_station.localization.settings import LocalizerSettings
    from ground_station.mapping.settings import MappingSettings

KINDS = ("homographies", "poses", "flights", "times")

EPILOG = """\
examples:
  blimp bench features --json out/features.json
  blimp bench features --only homographies times --extractors rootsift orb

homographies: DATA/illumination, pictures in the Oxford layout (NAME1.png, NAME2.png, NAME.H1to2p).
poses: DATA/redkitchen, a map of one pass, the preset 'default' in the other.
flights: a map of the sample's noon flight, the preset 'thesis' in a simulated flight at sunset.
What takes long is kept in the folder of --work and only measured again when a model, its input or
a setting has changed. Times are of one run on one machine; those of two machines do not compare."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    add = parser.add_argument
    add("--data", type=Path, default=Path("../shared/data"), metavar="DIR",
        help="folder of illumination/ and redkitchen/ (../shared/data)")  # fmt: skip
    add("--sample", type=Path, default=Path("maps/atrium"), metavar="DIR",
        help="folder of the sample's flights (maps/atrium)")  # fmt: skip
    add("--extractors", nargs="+", metavar="NAME", help="default: all there are")
    add("--only", nargs="+", choices=KINDS, metavar="WHAT",
        help=f"some of {', '.join(KINDS)} (default: all)")  # fmt: skip
    add("--quick", action="store_true", help="fewer frames: to see that all works")
    add("--max-features", type=int, default=1000, metavar="N", help="of a picture (1000)")
    add("--threads", type=int, default=0, metavar="N", help="of a network (0: one a core)")
    add("--repetitions", type=int, default=15, metavar="N", help="of each time (15)")
    add("--work", type=Path, default=Path("out/bench-features"), metavar="DIR",
        help="for flights, maps and rows that are kept (out/bench-features)")  # fmt: skip
    add("--json", type=Path, metavar="F", help="write the figures, too")


def run(args: argparse.Namespace) -> int:
    """Measures, prints the table; raises `BlimpError` for what a person can mend.

    What has no data is left out with a line that names it; asked for by `--only`, it is an error.
    """
    from ground_station.bench.features.table import table
    from ground_station.bench.steps import machine
    from ground_station.errors import InputError
    from ground_station.files import write_json

    for name, value, low, high in (
        ("--max-features", args.max_features, 50, 20000),
        ("--threads", args.threads, 0, 64),
        ("--repetitions", args.repetitions, 3, 10000),
    ):
        if not low <= value <= high:
            raise InputError(f"{name} is {value}; allowed: {low} to {high}")
    threads = args.threads or machine()["cores"]
    made = _extractors(args.extractors, args.max_features, threads)
    rows: dict[str, dict[str, Any]] = {
        name: {"name": name, "sha256": extractor.sha256, "dimension": extractor.dimension}
        for name, extractor in made.items()
    }
    measured = 0
    for kind in args.only or KINDS:
        try:
            _MEASURE[kind](args, made, rows, threads)
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
          + (", quick: figures of a few frames" if args.quick else ""))  # fmt: skip
    print("\n".join(["", *table(rows)]))
    if args.json:
        write_json(args.json, result)
    return 0


def _extractors(names: list[str] | None, most: int, threads: int) -> dict[str, Extractor]:
    from ground_station.features import extractors

    return {
        name: extractors.create(name, most, threads=threads)
        for name in dict.fromkeys(names or extractors.names())
    }


Rows = dict[str, dict[str, Any]]


def _homographies(
    args: argparse.Namespace, made: dict[str, Extractor], rows: Rows, threads: int
) -> None:
    from ground_station.bench.features import homographies
    from ground_station.progress import Progress

    pairs = homographies.read_pairs(args.data / "illumination")
    with Progress("homographies, extractors", len(made)) as progress:
        for name, extractor in made.items():
            scores = homographies.measure(extractor, pairs)
            rows[name]["homographies"] = homographies.summary(scores)
            progress.step()


def _poses(args: argparse.Namespace, made: dict[str, Extractor], rows: Rows, threads: int) -> None:
    from ground_station.bench.features import poses

    folder = args.data / "redkitchen"
    files = poses.inputs(folder)
    ranges = poses.QUICK if args.quick else poses.FULL

    def measure(mapping: MappingSettings, localizer: LocalizerSettings, work: Path) -> Any:
        return poses.measure(folder, mapping, localizer, ranges, work)

    about = {"kind": "poses", "ranges": [str(chosen) for chosen in ranges]}
    _in_maps(args, made, rows, "poses", "default", threads, files, about, measure)


def _flights(
    args: argparse.Namespace, made: dict[str, Extractor], rows: Rows, threads: int
) -> None:
    from ground_station.bench.features import flights

    files = flights.map_inputs(args.sample)
    duration_s = flights.QUICK_S if args.quick else flights.FULL_S
    step = flights.QUICK_STEP if args.quick else flights.FULL_STEP
    recording = flights.flight(args.work / "flights", duration_s)

    def measure(mapping: MappingSettings, localizer: LocalizerSettings, work: Path) -> Any:
        return flights.measure(args.sample, recording, mapping, localizer, step, work)

    about = {"kind": "flights", "step": step}
    _in_maps(
        args, made, rows, "flights", "thesis", threads, [*files, recording], about, measure,
        args.sample / "mapping.toml",
    )  # fmt: skip


def _in_maps(
    args: argparse.Namespace,
    made: dict[str, Extractor],
    rows: Rows,
    kind: str,
    preset: str,
    threads: int,
    files: list[Path],
    about: dict[str, Any],
    measure: Callable[[MappingSettings, LocalizerSettings, Path], dict[str, Any]],
    mapping_file: Path | None = None,
) -> None:
    """A row of every extractor: kept, or measured with the preset and nothing but it swapped."""
    import tempfile
    from dataclasses import asdict, replace

    from ground_station.bench.features import kept
    from ground_station.errors import MapError
    from ground_station.localization.settings import load_preset
    from ground_station.mapping.settings import load_settings

    contents = kept.digest(files)
    args.work.mkdir(parents=True, exist_ok=True)
    for name, extractor in made.items():
        mapping = replace(load_settings(mapping_file), features=name)
        settings = load_preset(preset)
        features = replace(settings.features, max_features=args.max_features, threads=threads)
        settings = replace(settings, features=features)

        def fresh(mapping: Any = mapping, settings: Any = settings) -> dict[str, Any]:
            with tempfile.TemporaryDirectory(dir=args.work, prefix="map-") as work:
                try:
                    return measure(mapping, settings, Path(work))
                except MapError as error:  # no map of these features is a result, too
                    return {"failed": str(error)}

        depends_on = about | {
            "files": contents,
            "model": extractor.sha256,
            "mapping": asdict(mapping),
            "localizer": asdict(settings),
        }
        rows[name][kind] = kept.row(args.work / "rows", depends_on, fresh)


def _times(args: argparse.Namespace, made: dict[str, Extractor], rows: Rows, threads: int) -> None:
    from ground_station.bench.features import timing
    from ground_station.recording.folder import read_grey

    frames = args.data / "redkitchen" / "frames"
    real = sorted(frames.iterdir())[:1] if frames.is_dir() else []
    image = read_grey(real[0]) if real else timing.picture(0)
    repetitions = 3 if args.quick else args.repetitions
    for name, found in timing.measure(made, image, repetitions).items():
        rows[name]["time"] = found


_MEASURE: dict[str, Callable[..., None]] = {
    "homographies": _homographies,
    "poses": _poses,
    "flights": _flights,
    "times": _times,
}
