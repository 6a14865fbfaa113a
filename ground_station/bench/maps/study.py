"""Features on sets of pictures with true poses: our build and COLMAP's own on the same images."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ground_station.arrays import F64
from ground_station.bench.maps import plain
from ground_station.errors import GeometryError, InputError
from ground_station.geometry import poses
from ground_station.geometry.alignment import align
from ground_station.geometry.camera import Camera, load_camera
from ground_station.geometry.trajectory import Trajectory, read_tum
from ground_station.mapping.construction.build import build_map
from ground_station.mapping.settings import MappingSettings, with_changes
from ground_station.mapping.sfm import robust_similarity
from ground_station.presentation.text import columns
from ground_station.progress import Progress
from ground_station.recording.flight import trajectory_of
from ground_station.recording.frames import Frame, FrameRange
from ground_station.recording.open import open_input
from pi_firmware.wire.errors import BlimpError
from pi_firmware.wire.recording import TRUTH_TOPIC

MISPLACED_DEPTH, MISPLACED_DEG = 0.05, 5.0
"""An image is misplaced when it is off by more than this share of the median depth of what the
map's images see, or is turned by more than this: far more than an error of measurement (a pixel at
500 px of focal length is 0.2 % of a depth), and less than the steps at which walls repeat."""


@dataclass(frozen=True)
class Judgement:
    """Errors of the centres after a similarity, metres; `misplaced` are `images` of the map."""

    registered: int
    median_m: float
    max_m: float
    rmse_m: float
    bound_m: float
    misplaced: tuple[str, ...]


def judge(names: list[str], wTc: F64, true: F64, depth: float, seed: int = 0) -> Judgement:
    """Poses `wTc` (K, 4, 4) of the images `names` against the true ones, (K, 4, 4), metres.

    `depth`, the median of what the images see, is in the units of `wTc`. The similarity is the one
    that most images agree on (LO-RANSAC, then least squares of those), so that a part that is
    folded over does not bend the rest. Where none is found, all images are misplaced.
    """
    source, target = wTc[:, :3, 3], true[:, :3, 3]
    none = Judgement(len(names), np.nan, np.nan, np.nan, np.nan, tuple(names))
    if len(names) < 3:
        return none
    # Metres to a unit, for the bound: distances between centres, of which most are right.
    i, j = np.triu_indices(len(names), 1)
    apart = np.linalg.norm(source[i] - source[j], axis=1)
    true_apart = np.linalg.norm(target[i] - target[j], axis=1)
    far = (apart > 0) & (true_apart > 0)
    if not far.any() or not depth > 0:
        return none
    bound_m = MISPLACED_DEPTH * depth * float(np.median(true_apart[far] / apart[far]))
    found = robust_similarity.similarity(source, target, bound_m, seed)
    if found is None:
        return none
    near = np.linalg.norm(found.apply(source) - target, axis=1) <= bound_m
    try:
        found = align(source[near], target[near], True)
    except GeometryError:
        return none
    bound_m = MISPLACED_DEPTH * depth * found.scale
    placed = found.apply_poses(wTc)
    off_m = np.linalg.norm(placed[:, :3, 3] - target, axis=1)
    turned = np.degrees(
        [float(poses.rotation_angle(a.T @ b)) for a, b in zip(placed[:, :3, :3], true[:, :3, :3],
                                                               strict=True)]
    )  # fmt: skip
    wrong = (off_m > bound_m) | (turned > MISPLACED_DEG)
    return Judgement(
        len(names), float(np.median(off_m)), float(off_m.max()),
        float(np.sqrt(np.mean(off_m**2))), bound_m,
        tuple(name for name, is_wrong in zip(names, wrong, strict=True) if is_wrong),
    )  # fmt: skip


def said(built: Mapping[str, Any]) -> dict[str, int]:
    """How many doubts, parts kept apart and images left out a build names in `map.toml`."""
    return {key: len(built.get(key) or ()) for key in ("doubts", "parts", "left_out")}


def is_silent_fold(misplaced: Sequence[str], told: Mapping[str, int]) -> bool:
    """Whether images are misplaced and the build has neither a doubt nor kept parts of it apart."""
    return bool(misplaced) and not (told["doubts"] or told["parts"])


SIMULATED: dict[str, dict[str, Any]] = {
    "atrium": {"scene": "atrium", "plan": "mapping", "rate_hz": 1.0},
    "office": {"scene": "office", "plan": "mapping", "rate_hz": 1.0},
    "corridor": {"scene": "corridor", "plan": "corridor", "rate_hz": 1.0},
    "stills": {"scene": "hall", "plan": "stills", "lens_error": 0.01},
    "headset": {"scene": "rooms", "plan": "headset", "lens_error": 0.01},
}
REAL: dict[str, dict[str, Any]] = {
    "hallway": {"folder": "hallway", "truth": "truth.txt", "rate_hz": 10.0,
                "range": FrameRange(0, 91, 2)},
    "kitchen": {"folder": "redkitchen", "truth": "official_groundtruth.txt", "rate_hz": 30.0,
                "range": FrameRange(0, 500, 5)},
}  # fmt: skip
"""By name: folder in the data, file of the true poses there, and which frames make the map."""

SAME_NS = 5_000_000
"""A frame is judged by a true pose within this time of its own."""


@dataclass(frozen=True)
class Pictures:
    """The images of one set, their camera as it is given to a build, and their true poses."""

    name: str
    simulated: bool
    frames: list[Frame]
    camera: Camera
    truth: Trajectory


def gather(name: str, seed: int, real: Path | None, work: Path, images: int | None) -> Pictures:
    """The set `name`, of at most `images` spread evenly; a simulated one is made once in `work`.

    Raises `InputError` for a real set that is not there.
    """
    if name in SIMULATED:
        path = _recorded(name, seed, work)
        source = open_input(path)
        camera, truth = source.camera, trajectory_of(path, TRUTH_TOPIC, [])
        if camera is None:
            raise InputError(f"{path}: it carries no camera calibration")
    else:
        about = REAL[name]
        folder = None if real is None else real / about["folder"]
        if folder is None or not folder.is_dir():
            raise InputError(f"{name}: left out, no folder '{about['folder']}' in --real")
        inside = folder / "frames"
        source = open_input(inside if inside.is_dir() else folder, about["rate_hz"], about["range"])
        camera, truth = load_camera(folder / "camera.toml"), read_tum(folder / about["truth"])
    frames = list(source)
    if images is not None and images < len(frames):
        frames = [frames[k] for k in np.linspace(0, len(frames) - 1, images).round().astype(int)]
    return Pictures(name, name in SIMULATED, frames, camera, truth)


def _recorded(name: str, seed: int, work: Path) -> Path:
    from ground_station.simulator.simulate import SimulationSettings, simulate

    path = work / f"{name}-{seed}.mcap"
    if path.is_file():
        return path
    settings = SimulationSettings(out=path, seed=seed, **SIMULATED[name])
    with Progress(f"simulate {path.name}, frames", None) as progress:
        if simulate(settings, lambda done, total: progress.step(total)).interrupted:
            path.unlink()
            raise KeyboardInterrupt
    return path


def _judged(
    pictures: Pictures, names: Sequence[str], wTc: np.ndarray[Any, Any], depth: float, seed: int
) -> dict[str, Any]:
    """The figures of a model's images that have a true pose."""
    time_ns = {frame.name: frame.time_ns for frame in pictures.frames}
    truth = pictures.truth
    rows, kept, true = [], [], []
    for k, name in enumerate(names):
        near = truth.nearest(time_ns[name])
        if abs(int(truth.time_ns[near]) - time_ns[name]) <= SAME_NS:
            rows.append(k)
            kept.append(name)
            true.append(truth.wTc[near])
    judged = judge(kept, wTc[rows], np.array(true).reshape(-1, 4, 4), depth, seed)
    return asdict(judged) | {"registered": len(names), "judged": len(kept)}


def ours(pictures: Pictures, settings: MappingSettings, work: Path) -> dict[str, Any]:
    """Our build's figures; `failed` has the one line where it made no map."""
    started = time.monotonic()
    try:
        map_ = build_map(
            pictures.frames, pictures.camera, settings, work / "map", total=len(pictures.frames)
        )
    except BlimpError as error:
        return {"failed": str(error), "registered": 0, "seconds": time.monotonic() - started}
    seconds = time.monotonic() - started
    kf = map_.keyframes
    row = _judged(pictures, kf.names, kf.wTc, map_.depth_m, settings.seed)
    told = said(map_.info.built)
    silent = is_silent_fold(row["misplaced"], told)
    models = len(map_.info.built.get("model_sizes", ())) or 1
    return row | {"models": models, "said": told, "silent_fold": silent, "seconds": seconds}


def colmaps(pictures: Pictures, seed: int, threads: int, work: Path) -> dict[str, Any]:
    """COLMAP's own figures on the same images."""
    folder = work / "pictures"
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.iterdir():
        old.unlink()
    for frame in pictures.frames:
        cv2.imwrite(str(folder / f"{frame.name}.png"), frame.image)
    started = time.monotonic()
    models = plain.reconstruct(folder, pictures.camera, work / "plain", seed, threads)
    seconds = time.monotonic() - started
    if not models:
        return {"failed": "no model", "registered": 0, "seconds": seconds}
    largest = models[0]
    names = [name.removesuffix(".png") for name in largest.names]
    row = _judged(pictures, names, largest.wTc, largest.depth, seed)
    return row | {"models": len(models), "seconds": seconds}


def run(
    sets: Sequence[str], features: Sequence[str], seeds: Sequence[int], settings: MappingSettings,
    real: Path | None, work: Path, images: int | None,
) -> list[dict[str, Any]]:  # fmt: skip
    """A row a case, printed as it is done; sets that are not there are said and left out."""
    rows: list[dict[str, Any]] = []
    for name in sets:
        for seed in seeds:
            try:
                pictures = gather(name, seed, real, work, images)
            except InputError as error:
                print(error)
                break
            place = work / f"{name}-{seed}"
            yardstick = colmaps(pictures, seed, settings.threads, place)
            for feature in features:
                changed = with_changes(settings, {"features": feature, "seed": seed}, "--features")
                row: dict[str, Any] = {
                    "set": name, "seed": seed, "features": feature,
                    "simulated": pictures.simulated, "images": len(pictures.frames),
                    "ours": ours(pictures, changed, place / feature), "plain": yardstick,
                }  # fmt: skip
                rows.append(row)
                print(
                    f"{name}, {feature}, seed {seed}: {row['ours']['registered']} registered,"
                    f" plain COLMAP {yardstick['registered']}, of {row['images']}", flush=True,
                )  # fmt: skip
    return rows


_HEAD = (
    "set", "features", "seed", "images", "registered", "models", "median, cm", "max, cm",
    "RMSE, cm", "misplaced", "doubts", "parts", "left out", "folded, unsaid", "s",
)  # fmt: skip


def table(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Lines: each build beside COLMAP's own of the same images, and the sum that must be 0."""
    lines = [[*_HEAD]]
    shown: set[tuple[str, int]] = set()
    for row in rows:
        kind = f"{row['set']}{' (simulated)' if row['simulated'] else ''}"
        start = [str(row["seed"]), str(row["images"])]
        if (row["set"], row["seed"]) not in shown:
            shown.add((row["set"], row["seed"]))
            lines.append([kind, "plain COLMAP", *start, *_cells(row["plain"])])
        lines.append([kind, row["features"], *start, *_cells(row["ours"])])
    fewer = sum(row["ours"]["registered"] < row["plain"]["registered"] for row in rows)
    silent = sum(row["ours"].get("silent_fold", False) for row in rows)
    return [
        *columns(lines),
        "",
        f"builds with fewer images registered than plain COLMAP: {fewer} of {len(rows)}",
        f"folded maps that were not said: {silent} of {len(rows)}",
    ]


def _cells(row: dict[str, Any]) -> list[str]:
    seconds = f"{row['seconds']:.0f}"
    if "failed" in row:
        return ["0", *["-"] * 9, seconds]
    errors = (
        "-" if np.isnan(row[key]) else f"{100 * row[key]:.1f}"
        for key in ("median_m", "max_m", "rmse_m")
    )
    told = row.get("said")
    notes = [str(told[key]) for key in ("doubts", "parts", "left_out")] if told else ["-"] * 3
    silent = "-" if told is None else "YES" if row["silent_fold"] else "no"
    return [str(row["registered"]), str(row["models"]), *errors, str(len(row["misplaced"])),
            *notes, silent, seconds]  # fmt: skip
