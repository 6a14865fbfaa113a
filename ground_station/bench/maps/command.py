"""`blimp bench map`: what a map's size costs, which builds are true, and what many images cost."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

EPILOG = """\
examples:
  blimp bench map maps/atrium --json out/bench-map.json
  blimp bench map --study hallway stills --features rootsift orb --real DATA --json out/study.json
  blimp bench map maps/atrium --flight F.mcap G.mcap --shares 0.5 --descriptor-bytes 32 --seeds 3
  blimp bench map --campus 1000 3000 10000 --processes 0 3 --plot out/campus.png

Every share of the landmarks is measured with every length of a descriptor, by the localizer's
preset 'default' from the first true pose. Shares are of one run on one machine; times of two
machines do not compare."""

_ALLOWED_GB = 6.0
"""What a build of ten thousand images may take."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    add = parser.add_argument
    add("map", type=Path, nargs="?", default=Path("maps/atrium"), metavar="MAP",
        help="folder of the map (maps/atrium)")  # fmt: skip
    add("--flight", type=Path, nargs="+", metavar="F.mcap",
        help="recordings that are localized (default: MAP's flight.mcap)")  # fmt: skip
    add("--truth", type=Path, metavar="TUM.txt",
        help="true poses of the one flight (default: its own)")  # fmt: skip
    add("--range", metavar="A:B[:S]", help="frames A to B-1 of each flight, every S-th")
    add("--shares", type=float, nargs="+", default=[1.0, 0.5, 0.25, 0.1], metavar="SHARE",
        help="of the landmarks that are kept (1 0.5 0.25 0.1)")  # fmt: skip
    add(
        "--descriptor-bytes",
        type=int,
        nargs="+",
        metavar="B",
        help="bytes a descriptor; 0: as they are (0, one for every four numbers, half of that)",
    )
    add("--methods", nargs="+", default=["coverage"], metavar="NAME",
        help="how landmarks are chosen: coverage, observations, random (coverage)")  # fmt: skip
    add("--sought", type=int, default=40, metavar="N",
        help="frames of each flight that are looked for in the whole map (40)")  # fmt: skip
    add("--seeds", type=int, default=1, metavar="N", help="runs of each line, means are shown (1)")
    add("--seed", type=int, default=0, metavar="N", help="of the first run (0)")
    study = parser.add_argument_group("instead: builds against COLMAP's own on the same images")
    study.add_argument("--study", nargs="+", metavar="SET",
        help="atrium, office, corridor, stills, headset (simulated); hallway, kitchen")  # fmt: skip
    study.add_argument("--features", nargs="+", default=["rootsift"], metavar="NAME",
        help="extractors or models that the builds use (rootsift)")  # fmt: skip
    study.add_argument("--real", type=Path, metavar="DIR", help="folder of the real sets' folders")
    study.add_argument("--images", type=int, metavar="N", help="at most so many of each set")
    study.add_argument("--work", type=Path, default=Path("out/study"), metavar="DIR",
        help="where recordings and maps are kept (out/study)")  # fmt: skip
    add("--campus", type=int, nargs="+", metavar="N",
        help="instead, build simulated campuses of N images: time and memory")  # fmt: skip
    add("--processes", type=int, nargs="+", default=[0], metavar="N",
        help="of --campus: Dask processes on this machine; 0: threads (0)")  # fmt: skip
    add("--json", type=Path, metavar="F", help="write the figures, too")
    add("--plot", type=Path, metavar="F.png", help="draw errors, or time and memory, over sizes")


def run(args: argparse.Namespace) -> int:
    """Measures, prints the tables; raises `BlimpError` for what a person can mend."""
    _check(args)
    if args.study:
        return _study(args)
    return _campus(args) if args.campus else _compressed(args)


def _campus(args: argparse.Namespace) -> int:
    from dataclasses import replace

    from ground_station.bench.maps import scale
    from ground_station.bench.steps import machine
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
        from ground_station.presentation.dress import write_png

        write_png(scaling_plot(rows, _ALLOWED_GB), args.plot)
    return 0


def _compressed(args: argparse.Namespace) -> int:
    import tempfile

    from ground_station.bench.maps import measure
    from ground_station.bench.maps.table import tables
    from ground_station.bench.steps import machine
    from ground_station.errors import InputError
    from ground_station.files import write_json
    from ground_station.localization.settings import load_preset
    from ground_station.map.store import load
    from ground_station.recording.frames import ALL_FRAMES
    from ground_station.recording.open import parse_range

    paths = args.flight or [args.map / "flight.mcap"]
    if args.truth is not None and len(paths) > 1:
        raise InputError(f"--truth {args.truth}: is of one flight; {len(paths)} are given")
    map_ = load(args.map)
    chosen = parse_range(args.range) if args.range else ALL_FRAMES
    flights = [measure.open_flight(path, chosen, args.truth) for path in paths]
    if len({flight.name for flight in flights}) < len(flights):
        raise InputError("--flight: two flights have the same name")
    settings = load_preset("default")
    sought = [(flight, measure.seek(flight, map_, settings, args.sought)) for flight in flights]
    seeds = range(args.seed, args.seed + args.seeds)
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory(prefix="bench-map-") as work:
        for name, wanted in _lines(args, map_):
            found = measure.row(args.map, wanted, sought, settings, seeds, Path(work))
            rows.append(name | found)
    about = {
        flight.name: {
            "simulated": flight.simulated,
            "frames": rows[0]["flights"][flight.name]["runs"][0]["frames"],
        }
        for flight in flights
    }
    cores = machine()["cores"]
    print(f"{map_.info.name}: {cores} cores, seeds {seeds[0]} to {seeds[-1]}, means of the runs")
    print("\n".join(tables(rows, about)))
    if args.json:
        result = {"map": map_.info.name, "machine": machine(), "seeds": list(seeds)}
        write_json(args.json, result | {"flights": about, "rows": rows})
    if args.plot:
        from ground_station.bench.maps.plot import sizes_plot
        from ground_station.presentation.dress import write_png

        write_png(sizes_plot(rows, about), args.plot)
    return 0


def _study(args: argparse.Namespace) -> int:
    """Builds every set with every feature and seed; 1 where a map is folded and did not say so."""
    from ground_station.bench.maps import study
    from ground_station.bench.steps import machine
    from ground_station.errors import InputError
    from ground_station.files import write_json
    from ground_station.mapping.settings import load_settings

    there = [*study.SIMULATED, *study.REAL]
    for name in args.study:
        if name not in there:
            raise InputError(f"--study has '{name}'; allowed: {', '.join(there)}")
    if args.images is not None and not 2 <= args.images <= 10_000:
        raise InputError(f"--images is {args.images}; allowed: 2 to 10000")
    seeds = range(args.seed, args.seed + args.seeds)
    rows = study.run(
        args.study, args.features, seeds, load_settings(), args.real, args.work, args.images
    )
    if rows:
        print("\n".join(study.table(rows)))
    if args.json:
        write_json(args.json, {"machine": machine(), "seeds": list(seeds), "rows": rows})
    return int(any(row["ours"].get("silent_fold", False) for row in rows))


def _check(args: argparse.Namespace) -> None:
    from ground_station.errors import InputError
    from ground_station.map_update.compression.choice import METHODS

    for name, value, low, high in (
        ("--sought", args.sought, 0, 10_000),
        ("--seeds", args.seeds, 1, 100),
        ("--seed", args.seed, 0, 2**31 - 101),
        *(("--campus", each, 50, 100_000) for each in args.campus or ()),
        *(("--processes", each, 0, 256) for each in args.processes),
        *(("--descriptor-bytes", each, 0, 4096) for each in args.descriptor_bytes or ()),
    ):
        if not low <= value <= high:
            raise InputError(f"{name} is {value}; allowed: {low} to {high}")
    for share in args.shares:
        if not 0 < share <= 1:
            raise InputError(f"--shares has {share:g}; allowed: above 0 to 1")
    for method in args.methods:
        if method not in METHODS:
            raise InputError(f"--methods has '{method}'; allowed: {', '.join(METHODS)}")
    for path in (args.json, args.plot):
        if path and not path.resolve().parent.is_dir():
            raise InputError(f"{path}: its folder does not exist")


def _lines(args: argparse.Namespace, map_: Any) -> list[tuple[dict[str, Any], Any]]:
    """What a line says of itself, and what is compressed how; the whole map comes first."""
    from ground_station.map_update.compression.codes import usual_bytes
    from ground_station.map_update.compression.compress import Compression

    asked = args.descriptor_bytes or [0, *(usual_bytes(map_.info.dimension, n) for n in (4, 8))]
    own = map_.info.compressed.get("descriptor_bytes", map_.info.dimension)
    lines: list[tuple[dict[str, Any], Any]] = [
        ({"name": "whole", "method": "", "share": 1.0, "descriptor_bytes": own}, None)
    ]
    for method in args.methods:
        for each in dict.fromkeys(asked):
            for share in dict.fromkeys(args.shares):
                name = f"{share:.4g}" + ("" if method == "coverage" else f", {method}")
                told = {"name": name, "method": method, "share": share}
                told["descriptor_bytes"] = each or own
                wanted = Compression(share, each, method=method)
                lines.append((told, wanted))
    return lines
