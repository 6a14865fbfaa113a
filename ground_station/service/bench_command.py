"""`blimp bench localize`: what the localizer's steps cost, in ratios of one run."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

_EPILOG = """\
example:
  blimp bench localize --map maps/atrium --json out/bench.json

Ratios are of one run on one machine; times of two machines do not compare."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    commands = parser.add_subparsers(dest="bench", required=True, metavar="WHAT")
    localize = commands.add_parser(
        "localize",
        help="association, pose, whole frames and growth with the map",
        description="Measures the localizer against the preset 'thesis' and plain methods.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
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
        help="sizes of the growth table (10000 1000000)",
    )  # fmt: skip
    localize.add_argument("--seed", type=int, default=0, metavar="N", help="of what is drawn (0)")
    localize.add_argument("--json", type=Path, metavar="F", help="write the figures, too")


def run(args: argparse.Namespace) -> int:
    """Measures, prints the tables; raises `InputError` for a value out of range."""
    from ground_station.errors import InputError
    from ground_station.files import write_json
    from ground_station.localization import bench
    from ground_station.mapping import store

    for name, value, low in (
        ("--frames", args.frames, 2),
        ("--repetitions", args.repetitions, 3),
        ("--seed", args.seed, 0),
    ):
        if value < low:
            raise InputError(f"{name} is {value}; at least {low} is needed")
    small, large = args.landmarks
    if not 100 <= small < large:
        raise InputError(f"--landmarks: 100 <= {small} < {large} is needed")
    map_ = store.load(args.map)
    recording = args.map / "flight.mcap"
    if not recording.is_file():
        raise InputError(f"{recording}: the map's flight is needed to measure whole frames")
    result: dict[str, Any] = {
        "machine": bench.machine(),
        "seed": args.seed,
        "repetitions": args.repetitions,
        "association": bench.association(args.seed, args.repetitions),
        "pose": bench.pose(args.seed, args.repetitions),
        "frame": bench.frames(map_, recording, args.frames),
        "growth": bench.growth(args.seed, args.repetitions, (small, large)),
    }
    print("\n".join(report(result)))
    if args.json:
        write_json(args.json, result)
    return 0


def report(result: dict[str, Any]) -> list[str]:
    """The tables as lines of plain text."""
    from ground_station.evaluation.text import columns

    machine, frame = result["machine"], result["frame"]
    association, pose, growth = result["association"], result["pose"], result["growth"]
    same = "the same pairs" if association["same"] else "OTHER pairs"
    apart = f"{1e3 * pose['apart_m']:.3f} mm apart"
    steps = [["step", "ours, ms", "other, ms", "ratio"]]
    for name, ours_ms, other_ms, ratio in (
        (f"association, a loop over features ({same})", *_values(association, "ours", "loop")),
        (f"pose, the graph ({apart})", *_values(pose, "direct", "graph")),
        (
            "pose and velocity by rows, the graph",
            *(pose["rolling_ms"], pose["graph_ms"], pose["graph_ms"] / pose["rolling_ms"]),
        ),
    ):
        steps.append([name, *_numbers(ours_ms, other_ms), f"{ratio:.1f}"])
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
    table = [["landmarks", "in view", "every landmark, ms", "through the index, ms"]]
    for row in growth:
        spans = _numbers(row["plain_ms"], row["indexed_ms"])
        table.append([f"{row['landmarks']}", f"{row['in_view']:.0f}", *spans])
    small, large = growth
    ratios = (large[key] / small[key] for key in ("plain_ms", "indexed_ms"))
    table.append(["ratio", "", *(f"{ratio:.2f}" for ratio in ratios)])
    title = "projection and association of a frame, same density in view"
    return [*lines, title, *columns(table)]


def _values(row: dict[str, Any], ours: str, other: str) -> tuple[float, float, float]:
    return row[f"{ours}_ms"], row[f"{other}_ms"], row["ratio"]


def _numbers(*values_ms: float) -> list[str]:
    return [f"{value:.2f}" for value in values_ms]
