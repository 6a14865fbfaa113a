"""Kidnapping and false relocalization, measured: run by hand, not by pytest.

    python tests/localization/relocalization_study.py maps/atrium --flights A.mcap ... \\
        --others OFFICE.mcap ../shared/data/redkitchen/frames@../shared/data/redkitchen/camera.toml

Single frames of other flights (recordings with their truth) must be found where they were taken;
frames of other buildings must not be found. Times are the process's CPU time, which other work on
the machine moves less; set OMP_NUM_THREADS=1, or waiting threads count, too. `INPUT@CAMERA.toml`
gives a folder its camera.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from ground_station.features.extractor import Features
from ground_station.features.rootsift import RootSift
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera, load_camera
from ground_station.localization.relocalization import Relocalizer
from ground_station.localization.settings import load_preset
from ground_station.mapping.store import Keyframes, Landmarks, Map, load
from ground_station.recording.flight import trajectory_of
from ground_station.recording.open import open_input


@dataclass
class Sight:
    """A frame without its picture; `wTc` is the truth where it is known."""

    features: Features
    wTc: np.ndarray | None


def sights(spec: str, step: int, cache: Path) -> tuple[Camera, list[Sight]]:
    """The features of every `step`-th frame; kept in `cache` for the next run."""
    path, _, camera_file = spec.partition("@")
    source = open_input(path)
    camera = load_camera(camera_file) if camera_file else source.camera
    assert camera is not None, f"{path} has no camera"
    truth = trajectory_of(path) if path.endswith(".mcap") else None
    extractor, found = RootSift(), []
    cache.mkdir(parents=True, exist_ok=True)
    key = path.strip("./").replace("/", "_")
    for frame in source:
        if frame.index % step:
            continue
        file = cache / f"{key}-{frame.index}.npz"
        if file.exists():
            with np.load(file) as kept:
                features = Features(kept["xy"], kept["score"], kept["descriptor"])
        else:
            features = extractor.extract(frame.image)
            np.savez(file, xy=features.keypoints_px, score=features.scores,
                     descriptor=features.descriptors)  # fmt: skip
        found.append(Sight(features, None if truth is None else truth.at(frame.time_ns)))
    return camera, found


def study(map_: Map, name: str, camera: Camera, frames: list[Sight], *, known: bool) -> int:
    """Prints one line of the table; returns how many were accepted."""
    settings = load_preset("default")
    relocalizer = Relocalizer(map_, camera, settings.recovery, settings.seed)
    errors, times, refused = [], [], Counter[str]()
    for sight in frames:
        normalized = camera.undistort(sight.features.keypoints_px)
        begin = time.process_time()
        found = relocalizer.find(sight.features, normalized)
        times.append(1e3 * (time.process_time() - begin))
        if isinstance(found, str):
            refused["".join("#" if c.isdigit() else c for c in found).replace("##", "#")] += 1
        else:
            truth = sight.wTc if known and sight.wTc is not None else found.wTc
            apart = poses.inverse(truth) @ found.wTc
            angle = np.degrees(float(poses.rotation_angle(apart[:3, :3])))
            errors.append((float(np.linalg.norm(apart[:3, 3])), angle))
    e = np.array(errors).reshape(-1, 2)
    line = f"{name:44s} {len(e):4d}/{len(frames):<4d}"
    if known and len(e):
        bad = int(((e[:, 0] > 0.25) | (e[:, 1] > 2)).sum())
        line += f" wrong {bad}; median {np.median(e[:, 0]):.3f} m {np.median(e[:, 1]):.2f} deg,"
        line += f" worst {e[:, 0].max():.3f} m {e[:, 1].max():.2f} deg;"
    p50, p95, top = np.percentile(times, [50, 95, 100])
    print(f"{line} {p50:.0f} ms CPU median, {p95:.0f} p95, {top:.0f} max", flush=True)
    for reason, count in refused.most_common(6):
        print(f"      {count:4d} {reason}")
    return len(e)


def grown(map_: Map, times: int) -> Map:
    """The map with `times` - 1 other buildings of its size beside it.

    Their descriptors mix two of its own each: as crowded, and alike only by chance.
    """
    lm, kf, rng = map_.landmarks, map_.keyframes, np.random.default_rng(times)
    landmarks, keyframes = [lm], [kf]
    for k in range(1, times):
        one, other = rng.permutation(len(lm)), rng.permutation(len(lm))
        mixed = lm.descriptor[one] + lm.descriptor[other]
        mixed /= np.linalg.norm(mixed, axis=1, keepdims=True)
        aside = np.array([40.0 * k, 0, 0])
        landmarks.append(replace(lm, position_m=lm.position_m + aside, descriptor=mixed))
        wTc = kf.wTc.copy()
        wTc[:, :3, 3] += aside
        seen = (kf.landmark + k * len(lm)).astype(np.int32)
        offset = kf.offset[1:] + k * len(kf.landmark)
        keyframes.append(replace(kf, wTc=wTc, landmark=seen, offset=offset))
    every = {f.name: np.concatenate([getattr(x, f.name) for x in landmarks]) for f in fields(lm)}
    sights = {
        f.name: np.concatenate([getattr(x, f.name) for x in keyframes])
        for f in fields(kf)
        if f.name != "names"
    }
    names = [name for x in keyframes for name in x.names]
    return replace(map_, landmarks=Landmarks(**every), keyframes=Keyframes(names=names, **sights))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("map", type=Path)
    parser.add_argument("--flights", nargs="*", default=[])
    parser.add_argument("--others", nargs="*", default=[])
    parser.add_argument("--step", type=int, default=1)
    parser.add_argument("--cache", type=Path, default=Path("out/reloc/cache"))
    parser.add_argument("--grow", type=int, default=1, help="the map, this many times over")
    args = parser.parse_args()
    map_ = grown(load(args.map), args.grow)
    print(f"{args.map}: {len(map_.landmarks)} landmarks, {len(map_.keyframes)} keyframes")
    for known, specs in ((True, args.flights), (False, args.others)):
        accepted = total = 0
        for spec in specs:
            camera, frames = sights(spec, args.step, args.cache)
            accepted += study(map_, spec.split("@")[0], camera, frames, known=known)
            total += len(frames)
        print(f"{'flights' if known else 'other buildings'}: {accepted} of {total} accepted")


if __name__ == "__main__":
    main()
