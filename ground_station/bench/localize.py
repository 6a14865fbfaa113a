"""`blimp bench localize`: what the localizer's steps cost, in ratios of one run."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

HELP = "association, pose, whole frames and growth with the map"
DESCRIPTION = "Measures the localizer against the preset 'thesis' and plain methods."
EPILOG = """\
example:
  blimp bench localize --map maps/atrium --json out/bench.json

Ratios are of one run on one machine; times of two machines do not compare."""


def add_arguments(localize: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    localize.add_argument(
        "--map", type=Path, default=Path("maps/atrium"), metavar="MAP",
        help="folder of a map with a flight.mcap (maps/atrium)",
    )  # fmt: skip
    localize.add_argument(
        "--frames", type=int, default=120, metavar="N", help="of the flight (120)"
    )
    localize.add_argument(
        "--repetitions", type=int, default=30, metavar="N", help="of each measurement (30)"
    )
    localize.add_argument(
        "--landmarks", type=int, nargs=2, default=[10_000, 1_000_000], metavar=("A", "B"),
        help="landmarks of the growth table's maps; memory is measured at B (10000 1000000)",
    )  # fmt: skip
    localize.add_argument("--seed", type=int, default=0, metavar="N", help="of what is drawn (0)")
    localize.add_argument("--json", type=Path, metavar="F", help="write the figures, too")


def run(args: argparse.Namespace) -> int:
    """Measures, prints the tables; raises `InputError` for a value out of range."""
    from ground_station.bench import growth, steps
    from ground_station.bench.machine import machine
    from ground_station.errors import InputError, check_options
    from ground_station.files import write_json
    from ground_station.map import store

    check_options(args, frames=(2, 10**6), repetitions=(3, 10**6), seed=(0, 2**32 - 1))
    small, large = args.landmarks
    if not 100 <= small < large:
        raise InputError(f"--landmarks: 100 <= {small} < {large} is needed")
    map_ = store.load(args.map)
    recording = args.map / "flight.mcap"
    if not recording.is_file():
        raise InputError(f"{recording}: the map's flight is needed to measure whole frames")
    result: dict[str, Any] = {
        "machine": machine(),
        "seed": args.seed,
        "repetitions": args.repetitions,
        "association": steps.association(args.seed, args.repetitions),
        "pose": steps.pose(args.seed, args.repetitions),
        "frame": steps.frames(map_, recording, args.frames),
        "growth": growth.growth(args.seed, args.repetitions, (small, large)),
        "memory": growth.memory(args.seed, large),
    }
    print("\n".join(report(result)))
    if args.json:
        write_json(args.json, result)
    return 0


def report(result: dict[str, Any]) -> list[str]:
    """The tables as lines of plain text."""
    from ground_station.presentation.text import columns

    machine, frame = result["machine"], result["frame"]
    association, pose = result["association"], result["pose"]
    same = "the same pairs" if association["same"] else "OTHER pairs"
    steps = [
        ["step", "ours, ms", "other, ms", "ratio"],
        [f"association, a loop over features ({same})",
         *_numbers(association["ours_ms"], association["loop_ms"]), f"{association['ratio']:.1f}"],
        ["pose and velocity by rows, the graph",
         *_numbers(pose["rolling_ms"], pose["graph_ms"]), f"{pose['ratio']:.1f}"],
    ]  # fmt: skip
    lines = [
        f"{machine['cores']} cores, {machine['blas_threads']} BLAS threads, seed {result['seed']}, "
        f"medians of {result['repetitions']}",
        "",
        *columns(steps),
    ]
    presets = frame["presets"]
    stages = dict.fromkeys(s for preset in presets.values() for s in preset["mean_ms"])
    rows = [
        ["mean a frame, ms", *presets],
        ["decode", *[f"{frame['decode_ms']:.2f}"] * len(presets)],
    ]
    for stage in [*(s for s in stages if s != "total"), "total"]:
        cells = [preset["mean_ms"].get(stage) for preset in presets.values()]
        rows.append([stage, *("-" if cell is None else f"{cell:.2f}" for cell in cells)])
    for label, key in (("total, median", "p50_ms"), ("total, 99 %", "p99_ms")):
        rows.append([label, *(f"{preset[key]:.2f}" for preset in presets.values())])
    rows.append(["localized", *(str(preset["localized"]) for preset in presets.values())])
    errors = (preset["position_rmse_m"] for preset in presets.values())
    rows.append(["position RMSE, m", *(f"{error:.4f}" for error in errors)])
    lines += ["", f"{frame['frames']} frames of the flight, 'background' is no part of the total"]
    lines += columns(rows)
    lines += [f"thesis over default, total: {frame['ratio']:.1f}", ""]
    return [*lines, *_growth(result["growth"]), *_memory(result["memory"])]


def _growth(growth: list[dict[str, Any]]) -> list[str]:
    from ground_station.presentation.text import columns

    stages = ("projection", "association", "pose", "total")
    table = [["landmarks", "density", "in view", *stages, "over the first", "by each landmark"]]
    for row in growth:
        ratio = row["total_ms"] / growth[0]["total_ms"]
        cells = [f"{row['landmarks']}", f"{row['density']}", f"{row['in_view']:.0f}"]
        cells += _numbers(*(row[f"{stage}_ms"] for stage in stages))
        table.append([*cells, f"{ratio:.2f}", *_numbers(row["project_all_ms"])])
    title = "a frame after its features as the map grows, ms; the same density in view, then more"
    return [title, *columns(table), "by each landmark: projection without the index", ""]


def _memory(memory: dict[str, Any]) -> list[str]:
    return [
        f"a localizer of {memory['landmarks']} landmarks: at most {memory['peak_mb']:.0f} MB "
        f"resident ({memory['idle_mb']:.0f} MB without a map), ready in {memory['load_s']:.1f} s, "
        f"a search of all of it {memory['search_s']:.2f} s"
    ]


def _numbers(*values_ms: float) -> list[str]:
    return [f"{value:.2f}" for value in values_ms]
