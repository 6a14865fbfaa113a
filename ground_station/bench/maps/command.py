"""`blimp bench map`: which builds are true, and what many images cost."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

HELP = "builds against COLMAP's own on the same images; many images"
DESCRIPTION = (
    "Measures which builds are true beside COLMAP's own, or what builds of many images cost."
)
EPILOG = """\
examples:
  blimp bench map --study hallway stills --features rootsift orb --real DATA --json out/study.json
  blimp bench map --campus 1000 3000 10000 --processes 0 3 --plot out/campus.png

Times of two machines do not compare."""

_ALLOWED_GB = 6.0
"""What a build of ten thousand images may take."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    add = parser.add_argument
    add("--seeds", type=int, default=1, metavar="N", help="runs of each line, means are shown (1)")
    add("--seed", type=int, default=0, metavar="N", help="of the first run (0)")
    add("--json", type=Path, metavar="F", help="write the figures, too")
    study = parser.add_argument_group("builds against COLMAP's own on the same images")
    study.add_argument("--study", nargs="+", metavar="SET",
        help="atrium, office, corridor, stills, headset (simulated); hallway, kitchen")  # fmt: skip
    study.add_argument("--features", nargs="+", default=["rootsift"], metavar="NAME",
        help="extractors or models that the builds use (rootsift)")  # fmt: skip
    study.add_argument("--real", type=Path, metavar="DIR", help="folder of the real sets' folders")
    study.add_argument("--images", type=int, metavar="N", help="at most so many of each set")
    study.add_argument("--work", type=Path, default=Path("out/study"), metavar="DIR",
        help="where recordings and maps are kept (out/study)")  # fmt: skip
    campus = parser.add_argument_group("or time and memory of many images")
    add = campus.add_argument
    add("--campus", type=int, nargs="+", metavar="N",
        help="build simulated campuses of N images")  # fmt: skip
    add("--processes", type=int, nargs="+", default=[0], metavar="N",
        help="of --campus: Dask processes on this machine; 0: threads (0)")  # fmt: skip
    add("--plot", type=Path, metavar="F.png", help="draw them over the number of images")


def run(args: argparse.Namespace) -> int:
    """Measures, prints the tables; raises `BlimpError` for what a person can fix."""
    from ground_station.errors import InputError, check_options
    from ground_station.files import check_outputs

    check_options(
        args, seeds=(1, 100), seed=(0, 2**31 - 101), images=(2, 10_000), campus=(50, 100_000),
        processes=(0, 256),
    )  # fmt: skip
    if bool(args.study) == bool(args.campus):
        raise InputError("bench map measures --study SET or --campus N; give one of them")
    check_outputs(args.json, args.plot)
    return _study(args) if args.study else _campus(args)


def _campus(args: argparse.Namespace) -> int:
    from dataclasses import replace

    from ground_station.bench.machine import machine
    from ground_station.bench.maps import scale
    from ground_station.files import write_json
    from ground_station.mapping.settings import load_settings

    rows: list[dict[str, Any]] = []
    for row in scale.measured(
        args.campus, args.processes, replace(load_settings(), seed=args.seed)
    ):
        rows.append(row)
        if args.json:  # the next may take an hour
            write_json(args.json, {"machine": machine(), "seed": args.seed, "campus": rows})
    print("\n".join(scale.table(rows)))
    if args.plot:
        from ground_station.bench.maps.plot import scaling_plot
        from ground_station.presentation.theme import write_png

        write_png(scaling_plot(rows, _ALLOWED_GB), args.plot)
    return 0


def _study(args: argparse.Namespace) -> int:
    """Builds every set with every feature and seed; 1 where a map is folded and did not say so."""
    from ground_station.bench.machine import machine
    from ground_station.bench.maps import study
    from ground_station.errors import InputError
    from ground_station.files import write_json
    from ground_station.mapping.settings import load_settings

    there = [*study.SIMULATED, *study.REAL]
    for name in args.study:
        if name not in there:
            raise InputError(f"--study has '{name}'; allowed: {', '.join(there)}")
    seeds = range(args.seed, args.seed + args.seeds)
    rows = study.run(
        args.study, args.features, seeds, load_settings(), args.real, args.work, args.images
    )
    if rows:
        print("\n".join(study.table(rows)))
    if args.json:
        write_json(args.json, {"machine": machine(), "seeds": list(seeds), "rows": rows})
    return int(any(row["ours"].get("silent_fold", False) for row in rows))
