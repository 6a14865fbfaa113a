"""Measures what extending a noon map by a sunset flight is good for. Minutes; not a test.

A sunset flight is added to the sample's noon map; then another sunset flight and a noon flight, of
other seeds, are localized in the map as it was and as it is, by the default preset from nothing but
their pictures: how many frames, and how far off (position RMSE, not aligned). With --same-light the
flight that is added is a noon flight, too: what a map loses by growing.

    .venv/bin/python tests/mapping/extension/measure_extend.py --out out/extend --json out/e.json
"""

from __future__ import annotations

import argparse
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
from ground_station.mapping import store
from ground_station.recording.flight import FlightRecording, trajectory_of

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


def judge(path: Path, map_: Path, out: Path) -> dict[str, float]:
    """A flight localized in a map."""
    figures, poses = out / "judged.json", out / "judged.txt"
    done = [sys.executable, "-m", "ground_station.cli", "localize", str(path), "--map", str(map_),
            "--out", str(poses), "--json", str(figures)]  # fmt: skip
    code = subprocess.run(done, cwd=ROOT, stdout=sys.stderr, check=False).returncode
    document = json.loads(figures.read_text())
    result: dict[str, float] = {
        "frames": document["frames"]["captured"],
        "localized": document["frames"]["localized"],
        "tracking": document["states"]["TRACKING"],
        "rate_hz": document["rate_hz"],
        "rmse_m": float("nan"),
        "median_m": float("nan"),
    }
    if code == 0:
        found, truth = read_tum(poses), trajectory_of(path)
        at = [truth.nearest(int(time_ns)) for time_ns in found.time_ns]
        off_m = np.linalg.norm(found.wTc[:, :3, 3] - truth.wTc[at][:, :3, 3], axis=1)
        result["rmse_m"] = round(float(np.sqrt(np.mean(off_m**2))), 4)
        result["median_m"] = round(float(np.median(off_m)), 4)
    return result


def cost(path: Path, folders: list[Path], frames: int) -> dict[str, dict[str, float]]:
    """Median milliseconds of matching a described frame in each map, turn by turn in one run.

    Every frame is described and located by itself, from the true pose of the frame before it.
    """
    settings = load_preset("default")
    source = FlightRecording(path)
    truth = trajectory_of(path)
    maps = [store.load(folder) for folder in folders]
    camera = source.camera or maps[0].info.camera
    extractor = extractor_for(maps[0].info, settings.features)
    localizers = [Localizer(map_, camera, extractor, settings) for map_ in maps]
    spans: list[list[dict[str, float]]] = [[] for _ in maps]
    sights: list[list[int]] = [[] for _ in maps]
    for k, frame in enumerate(source):
        if k >= frames:
            break
        features = extractor.extract(frame.image)
        guess = truth.wTc[truth.nearest(frame.time_ns)].copy()
        guess[:3, 3] += [0.02, -0.02, 0.01]
        for turn in np.roll(np.arange(len(maps)), k).tolist():
            localizers[turn].reset()
            localizers[turn].set_initial_pose(guess, frame.time_ns - 33_000_000)
            estimate = localizers[turn].process_features(frame.time_ns, features)
            spans[turn].append(estimate.stage_ms)
            sights[turn].append(estimate.counts.inliers)
    return {
        str(folder): {
            **{
                f"{stage}_ms": round(float(np.median([s.get(stage, 0.0) for s in mine])), 3)
                for stage in ("projection", "association", "pose", "total")
            },
            "inliers": float(np.median(seen)),
        }
        for folder, mine, seen in zip(folders, spans, sights, strict=True)
    }


def main() -> None:
    """Prints a line for each flight and map."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of the maps")
    parser.add_argument("--map", type=Path, default=ROOT / "maps" / "atrium")
    parser.add_argument("--plan", default="loop")
    parser.add_argument("--light", default="sunset")
    parser.add_argument("--add", type=int, nargs="+", default=[501], help="seeds of flights added")
    parser.add_argument("--judge", type=int, default=502, help="seed of the flights that judge")
    parser.add_argument("--duration-s", type=float, default=15.0)
    parser.add_argument("--rate-hz", type=float, default=10.0)
    parser.add_argument("--settings", type=Path, help="of the extension")
    parser.add_argument("--name", default="extended", help="of the extended map")
    parser.add_argument("--same-light", action="store_true", help="add noon flights")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    out = args.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    length = args.duration_s, args.rate_hz
    light = "noon" if args.same_light else args.light
    added = [flight(args.plan, light, seed, *length) for seed in args.add]
    extended, report = out / args.name, out / f"{args.name}.json"
    if not report.is_file():
        more = ["--settings", args.settings] if args.settings else []
        blimp("map", "extend", args.map, *added, "--out", extended, "--json", report, *more)
    document: dict[str, Any] = {"extended": json.loads(report.read_text()), "flights": {}}
    print("flight", "map", *FIGURES, sep="\t")
    for each in (args.light, "noon"):
        path = flight(args.plan, each, args.judge, *length)
        for when, map_ in (("before", args.map), ("after", extended)):
            found = judge(path, map_, out)
            document["flights"][f"{each} {when}"] = found
            print(each, when, *(found.get(name, "") for name in FIGURES), sep="\t", flush=True)
    document["cost"] = cost(
        flight(args.plan, "noon", args.judge, *length), [args.map, extended], 40
    )
    for folder, row in document["cost"].items():
        print(Path(folder).name, *(f"{name} {value:g}" for name, value in row.items()), sep="\t")
    for name in ("keyframes", "landmarks", "modes", "bytes"):
        print(name, *document["extended"][name], sep="\t")
    if args.json:
        args.json.write_text(json.dumps(document, indent=2) + "\n")


if __name__ == "__main__":
    main()
