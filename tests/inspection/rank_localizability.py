"""Measures whether the localizability map tells good places from poor ones. Minutes; not a test.

A map of a part of the sample's mapping flight, then simulated flights of other seeds that pass the
mapped part and leave it, localized with the default preset: Spearman's rank correlation between
predicted deviation at the true poses and the actual error, as `blimp map view --compare` prints it.

    .venv/bin/python tests/inspection/rank_localizability.py --out out/rank
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from pathlib import Path

from ground_station.geometry.trajectory import write_tum
from ground_station.recording.flight import trajectory_of

ROOT = Path(__file__).parents[2]
SAMPLE = ROOT / "maps" / "atrium"
FIGURES = (
    "frames", "localized", "predicted_lost", "lost_and_predicted", "rank_correlation",
    "rank_correlation_of_localized", "rank_correlation_per_second", "median_error_m",
    "median_predicted_m",
)  # fmt: skip


def blimp(*words: object) -> None:
    """Runs the command; what it prints goes to standard error."""
    command = [sys.executable, "-m", "ground_station.cli", *map(str, words)]
    print("blimp", *words[:3], "…", file=sys.stderr, flush=True)
    subprocess.run(command, cwd=ROOT, stdout=sys.stderr, check=True)


def part_of_the_sample(out: Path, frames: str) -> Path:
    """A registered map of some frames of the sample's mapping flight, with its floor plan."""
    folder = out / f"part-{frames.replace(':', '-')}"
    if not (folder / "map.toml").is_file():
        blimp("map", "build", SAMPLE / "mapping.mcap", "--range", frames, "--out", folder)
        truth = out / "mapping.txt"
        write_tum(truth, trajectory_of(SAMPLE / "mapping.mcap"))
        blimp("map", "register", folder, "--trajectory", truth)
        for name in ("floorplan.png", "floorplan.yaml"):
            shutil.copy(SAMPLE / name, folder / name)
    return folder


def measure(
    out: Path, map_: Path, plan: str, light: str, seed: int, length: list[object]
) -> dict[str, float]:
    """The figures of one flight; pictures and poses stay in `out` and are taken up again."""
    flight = out / f"{plan}-{light}-{seed}.mcap"
    name = f"{map_.name}-{flight.stem}"
    estimate, figures = out / f"{name}.txt", out / f"{name}.json"
    if not flight.is_file():
        blimp("simulate", "--plan", plan, "--light", light, "--seed", seed, *length,
              "--out", flight)  # fmt: skip
    if not estimate.is_file():
        blimp("localize", flight, "--map", map_, "--out", estimate)
    blimp("map", "view", map_, "--out", out / f"{name}.html", "--compare", estimate, flight,
          "--json", figures)  # fmt: skip
    return dict(json.loads(figures.read_text())["compared"])


def main() -> None:
    """Prints a line a flight."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--frames", default="0:40", help="of the mapping flight; all: the sample")
    parser.add_argument("--plan", default="loop")
    parser.add_argument("--light", default="noon")
    parser.add_argument("--duration-s", type=float, default=35.0)
    parser.add_argument("--rate-hz", type=float, default=10.0)
    parser.add_argument("--seeds", type=int, nargs="+", default=[401, 402, 403])
    args = parser.parse_args()
    out = args.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    map_ = SAMPLE if args.frames == "all" else part_of_the_sample(out, args.frames)
    length = ["--duration-s", args.duration_s, "--rate-hz", args.rate_hz]
    print("seed", *FIGURES, sep="\t")
    for seed in args.seeds:
        found = measure(out, map_, args.plan, args.light, seed, length)
        print(seed, *(found[name] for name in FIGURES), sep="\t", flush=True)


if __name__ == "__main__":
    main()
