"""`blimp evaluate`: how far an estimated trajectory is from the true one."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ground_station.evaluation.ate import Evaluation
    from ground_station.geometry.trajectory import Trajectory

_EPILOG = """\
examples:
  blimp evaluate out/est.txt ../shared/data/redkitchen/pseudo_groundtruth.txt
  blimp evaluate out/est.txt out/flight.mcap --align se3 --json out/ate.json --plot out/ate.png

Trajectories are TUM text (timestamp tx ty tz qx qy qz qw; seconds, metres, camera to world).
position is the RMSE of |p - p'|, as evo_ape prints; rotation the RMSE of the angle of R R'^T;
Zhang is |p - dR p'| after Zhang and Scaramuzza, which grows with the distance from the origin.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.description = "Compares an estimated trajectory with the true one."
    parser.epilog = _EPILOG
    parser.set_defaults(
        next="blimp map view maps/NAME --out map.html    (where in the building a map is weak)"
    )
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("estimate", metavar="EST.txt", type=Path, help="TUM text, or a recording")
    parser.add_argument(
        "truth", metavar="TRUTH.txt", type=Path, help="TUM text, or a recording (its /truth/pose)"
    )
    parser.add_argument(
        "--align",
        choices=("none", "se3", "sim3"),
        help="one alignment only; default: a table of the three, shares unaligned",
    )
    parser.add_argument(
        "--max-diff-s",
        type=float,
        default=0.01,
        metavar="S",
        help="most seconds between the two poses of a pair (default: 0.01)",
    )
    parser.add_argument("--json", type=Path, metavar="F", help="write the result as JSON")
    parser.add_argument("--plot", type=Path, metavar="F.png", help="draw path and errors")


def run(args: argparse.Namespace) -> int:
    """Prints the table, writes what was asked for, returns the exit status."""
    from ground_station.errors import GeometryError
    from ground_station.evaluation import ate

    notes: list[str] = []
    estimate, truth = _read(args.estimate, False, notes), _read(args.truth, True, notes)
    for note in notes:
        print(note, file=sys.stderr)
    result = ate.evaluate(estimate, truth, args.max_diff_s)
    if args.align in result.impossible:
        raise GeometryError(f"{args.estimate}: {result.impossible[args.align]}")
    print(_heading(result, len(estimate), len(truth), args))
    print(table(result, [args.align] if args.align else list(ate.ALIGNMENTS)))
    if args.json:
        from ground_station.files import write_json

        write_json(args.json, _document(result, estimate, truth, args))
    if args.plot:
        from ground_station.evaluation import plots
        from ground_station.presentation.theme import write_png

        write_png(plots.evaluation(result, args.align or "none"), args.plot)
    return 0


def _read(path: Path, is_truth: bool, notes: list[str]) -> Trajectory:
    from ground_station.geometry.trajectory import read_tum

    if path.suffix.lower() != ".mcap":
        return read_tum(path)
    from ground_station.recording.flight import trajectory_of
    from pi_firmware.wire.recording import ESTIMATE_TOPIC, TRUTH_TOPIC

    return trajectory_of(path, TRUTH_TOPIC if is_truth else ESTIMATE_TOPIC, notes)


def _heading(result: Evaluation, estimated: int, true: int, args: argparse.Namespace) -> str:
    return (
        f"estimate  {args.estimate}\n"
        f"truth     {args.truth}\n"
        f"pairs     {result.pairs} of {estimated} estimated and {true} true poses, "
        f"at most {args.max_diff_s:g} s apart\n"
    )


def table(result: Evaluation, names: list[str]) -> str:
    """The errors of the alignments `names`, then the shares of the first of them, as plain text."""
    from ground_station.evaluation import ate
    from ground_station.presentation.text import columns

    rows = [
        ["alignment", "position, m", "", "", "rotation, °", "", "", "Zhang, m"],
        ["", "RMSE", "median", "max", "RMSE", "median", "max", "RMSE"],
    ]
    for name in (n for n in names if n in result.errors):
        e = result.errors[name]
        p, r = ate.Statistics.of(e.position_m), ate.Statistics.of(e.rotation_deg)
        rows.append(
            [name]
            + [f"{value:.4f}" for value in (p.rmse, p.median, p.max)]
            + [f"{value:.3f}" for value in (r.rmse, r.median, r.max)]
            + [f"{e.rmse()['position_zhang_m']:.4f}"]
        )
    lines = columns(rows)
    lines += [f"{n}: impossible, {result.impossible[n]}" for n in names if n in result.impossible]
    if "sim3" in names and "sim3" in result.errors:
        lines += ["", f"scale of sim3   {result.errors['sim3'].alignment.scale:.6f}"]
    shares = [
        [f"within {100 * one['position_m']:g} cm, {one['rotation_deg']:g}°", f"{one['share']:.1%}",
         f"of the pairs ({names[0]})"]
        for one in ate.shares(result.errors[names[0]])
    ]  # fmt: skip
    lines += ["", *columns(shares)]
    return "\n".join(lines)


def _document(
    result: Evaluation, estimate: Trajectory, truth: Trajectory, args: argparse.Namespace
) -> dict[str, Any]:
    from ground_station.evaluation import ate

    name = args.align or "none"
    return {
        "estimate": str(args.estimate),
        "truth": str(args.truth),
        "max_diff_s": args.max_diff_s,
        "pairs": result.pairs,
        "estimate_poses": len(estimate),
        "truth_poses": len(truth),
        "coverage": ate.coverage(estimate, truth.time_ns, args.max_diff_s),
        "ate": result.ate(),
        "statistics": {key: e.statistics() for key, e in result.errors.items()},
        "scale": result.errors["sim3"].alignment.scale if "sim3" in result.errors else None,
        "shares_align": name,
        "shares": ate.shares(result.errors[name]),
    }
