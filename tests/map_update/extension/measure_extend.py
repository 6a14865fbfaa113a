"""Measures what extending a noon map by a sunset flight is good for. Minutes; not a test.

A sunset flight is added to the sample's noon map; then another sunset flight, of another seed, and
the sample's noon flight, at 10 Hz, are localized in the map as it was and as it is, by the default
preset from nothing but their pictures: how many frames, and how far off (position RMSE, not
aligned). With --same-light the flight that is added is a noon flight, too: what a map loses by
growing.

    .venv/bin/python tests/map_update/extension/measure_extend.py --out out/extend --json out/e.json
"""

from __future__ import annotations

import argparse
import itertools
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from ground_station.geometry.trajectory import read_tum
from ground_station.localization.extraction import extractor_for
from ground_station.localization.localizer import Localizer
from ground_station.localization.settings import load_preset
from ground_station.map import store
from ground_station.recording.flight import FlightRecording, trajectory_of
from ground_station.recording.open import parse_range

ROOT = Path(__file__).parents[3]
FLIGHTS = ROOT / "out" / "cache" / "flights"
FIGURES = ("frames", "localized", "tracking", "rmse_m", "median_m", "rate_hz")


def blimp(*words: object) -> None:
    """Runs the command; what it prints goes to standard error."""
    command = [sys.executable, "-m", "ground_station.cli", *map(str, words)]
    print("blimp", *words[:3], "…", file=sys.stderr, flush=True)
    subprocess.run(command, cwd=ROOT, stdout=sys.stderr, check=True)


def flight(plan: str, light: str, seed: int, duration_s: float, rate_hz: float) -> Path:
    """A simulated flight in the atrium, made once."""
    name = f"atrium-{plan}-{light}-{seed}-{duration_s:g}-{rate_hz:g}hz.mcap"
    path = FLIGHTS / name
    if not path.is_file():
        FLIGHTS.mkdir(parents=True, exist_ok=True)
        part = path.with_name("part-" + name)
        blimp("simulate", "--plan", plan, "--light", light, "--seed", seed, "--duration-s",
              duration_s, "--rate-hz", rate_hz, "--out", part)  # fmt: skip
        part.replace(path)
    return path


def judge(path: Path, frames: str, map_: Path, out: Path) -> dict[str, float]:
    """A flight localized in a map; what was measured before is taken up again."""
    name = f"{map_.name}-{path.stem}"
    figures, poses = out / f"{name}.json", out / f"{name}.txt"
    if not figures.is_file():
        words = ["localize", path, "--map", map_, "--out", poses, "--json", figures,
                 "--range", frames]  # fmt: skip
        command = [sys.executable, "-m", "ground_station.cli", *map(str, words)]
        subprocess.run(command, cwd=ROOT, stdout=sys.stderr, check=False)
    document = json.loads(figures.read_text())
    result: dict[str, float] = {
        "frames": document["frames"]["captured"],
        "localized": document["frames"]["localized"],
        "tracking": document["states"]["TRACKING"],
        "rate_hz": document["rate_hz"],
        "rmse_m": float("nan"),
        "median_m": float("nan"),
    }
    if result["localized"]:
        found, truth = read_tum(poses), trajectory_of(path)
        at = [truth.nearest(int(time_ns)) for time_ns in found.time_ns]
        off_m = np.linalg.norm(found.wTc[:, :3, 3] - truth.wTc[at][:, :3, 3], axis=1)
        result["rmse_m"] = round(float(np.sqrt(np.mean(off_m**2))), 4)
        result["median_m"] = round(float(np.median(off_m)), 4)
    return result


def cost(path: Path, wanted: str, folders: list[Path], frames: int) -> list[dict[str, float]]:
    """Median milliseconds and inliers of frames located in each map, turn by turn in one run.

    Each by its own features, from 3 cm beside its true pose, and as if nothing came before.
    """
    settings = load_preset("default")
    source = FlightRecording(path, parse_range(wanted))
    truth = trajectory_of(path)
    maps = [store.load(folder) for folder in folders]
    camera = source.camera or maps[0].info.camera
    extractor = extractor_for(maps[0].info, settings.features)
    localizers = [Localizer(map_, camera, extractor, settings) for map_ in maps]
    spans: list[list[dict[str, float]]] = [[] for _ in maps]
    observations: list[list[int]] = [[] for _ in maps]
    for k, frame in enumerate(itertools.islice(source, frames)):
        features = extractor.extract(frame.image)
        guess = truth.wTc[truth.nearest(frame.time_ns)].copy()
        guess[:3, 3] += [0.02, -0.02, 0.01]
        for turn in np.roll(np.arange(len(maps)), k).tolist():
            localizers[turn].reset()
            localizers[turn].set_initial_pose(guess, frame.time_ns - 33_000_000)
            estimate = localizers[turn].process_features(frame.time_ns, features)
            spans[turn].append(estimate.stage_ms)
            observations[turn].append(estimate.counts.inliers)
    return [
        {
            **{
                f"{stage}_ms": round(float(np.median([s.get(stage, 0.0) for s in mine])), 3)
                for stage in ("projection", "association", "pose", "total")
            },
            "inliers": float(np.median(seen)),
        }
        for mine, seen in zip(spans, observations, strict=True)
    ]


def main() -> None:
    """Prints a line for each flight and map."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of the maps")
    parser.add_argument("--map", type=Path, default=ROOT / "maps" / "atrium")
    parser.add_argument("--plan", default="loop")
    parser.add_argument("--light", default="sunset")
    parser.add_argument("--add", type=int, nargs="+", default=[501], help="seeds of flights added")
    parser.add_argument("--judge", type=int, default=502, help="seed of the flight that judges")
    parser.add_argument("--duration-s", type=float, default=12.0, help="of those that judge")
    parser.add_argument("--rate-hz", type=float, default=10.0, help="of those that judge")
    parser.add_argument("--noon-range", default="0:450:3", help="of the map's flight.mcap")
    parser.add_argument("--add-duration-s", type=float, default=48.0, help="48: a lap of the loop")
    parser.add_argument("--add-rate-hz", type=float, default=5.0)
    parser.add_argument("--add-range", default=":", help="of the frames of those added")
    parser.add_argument("--settings", type=Path, help="of the extension")
    parser.add_argument("--name", default="extended", help="of the extended map")
    parser.add_argument("--same-light", action="store_true", help="add noon flights")
    parser.add_argument("--frames", type=int, default=40, help="of each flight that are timed")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    out = args.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    length = args.duration_s, args.rate_hz
    light = "noon" if args.same_light else args.light
    longer = args.add_duration_s, args.add_rate_hz
    added = [flight(args.plan, light, seed, *longer) for seed in args.add]
    extended, report = out / args.name, out / f"{args.name}.json"
    if not report.is_file():
        more = ["--range", args.add_range]
        more += ["--settings", args.settings] if args.settings else []
        blimp("map", "extend", args.map, *added, "--out", extended, "--json", report, *more)
    document: dict[str, Any] = {"extended": json.loads(report.read_text()), "flights": {}}
    print("flight", "map", *FIGURES, sep="\t")
    judges = {
        args.light: (flight(args.plan, args.light, args.judge, *length), ":"),
        "noon": (args.map / "flight.mcap", args.noon_range),
    }
    for each, (path, frames) in judges.items():
        for when, map_ in (("before", args.map), ("after", extended)):
            found = judge(path, frames, map_, out)
            document["flights"][f"{each} {when}"] = found
            print(each, when, *(found.get(name, "") for name in FIGURES), sep="\t", flush=True)
    for each, (path, frames) in judges.items():
        spent = cost(path, frames, [args.map, extended], args.frames)
        document[f"described by {each}"] = spent
        for when, row in zip(("before", "after"), spent, strict=True):
            print(each, when, *(f"{name} {value:g}" for name, value in row.items()), sep="\t")
    for name in ("keyframes", "landmarks", "modes", "bytes"):
        print(name, *document["extended"][name], sep="\t")
    if args.json:
        args.json.write_text(json.dumps(document, indent=2) + "\n")


if __name__ == "__main__":
    main()
