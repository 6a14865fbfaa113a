"""A corridor as geometry alone: points on a wall, some of which come again in every bay.

No picture is rendered and no descriptor compared. What a matcher would say follows from which
points two images see: a point that comes again is matched where each of them sees it once, be it in
another bay. Of the bays that the matches speak for, verification keeps the strongest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ground_station.arrays import F64
from ground_station.features.extractor import Features
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.mapping.construction.images import Images
from ground_station.mapping.sfm.two_view import TwoView

BAY_M = 2.5
WALL_M = 2.6
"""Distance of the wall from the middle of the way."""
NOISE_PX = 0.3
STEP_NS = 400_000_000

# Camera axes in the world's, looking along +y: x right, y down, z forward.
_NORTH = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


@dataclass
class Corridor:
    """Frames of a way along the wall: true poses (K, 4, 4), what they see, and verified pairs.

    `misled`: the pairs whose geometry is that of two places which are not the images'.
    """

    camera: Camera
    wTc: F64
    images: Images
    pairs: dict[tuple[int, int], TwoView]
    misled: set[tuple[int, int]]


def there_and_back(frames: int, length_m: float, rng: np.random.Generator) -> npt.NDArray:
    """Poses of a camera that flies along the wall and back, and looks a little ahead or behind."""
    s = np.linspace(0, 2, frames, endpoint=False)
    x = 1.3 + (length_m - 2.6) * np.where(s < 1, s, 2 - s)
    y = np.where(s < 1, -0.2, 0.2) + 0.03 * rng.normal(size=frames)
    z = 1.5 + 0.1 * np.sin(5 * s)
    turn = 0.25 * np.cos(np.pi * s) + 0.05 * rng.normal(size=frames)
    rotation = [
        np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]]) @ _NORTH
        for a in turn
    ]
    return poses.pose(np.array(rotation), np.stack([x, y, z], axis=1))


def make_corridor(
    frames: int = 48, bays: int = 4, own: int = 40, alike: int = 45, seed: int = 5
) -> Corridor:
    """`own` points of each bay are only there, `alike` come in every bay at the same place."""
    rng = np.random.default_rng(seed)
    camera = Camera()
    box = np.array([BAY_M, 0.5, 2.6])
    pattern = rng.uniform(0, 1, (alike, 3)) * box
    points, kind, bay = [], [], []
    for k in range(bays):
        shift = np.array([k * BAY_M, WALL_M - 0.4, 0.2])
        points += [rng.uniform(0, 1, (own, 3)) * box + shift, pattern + shift]
        kind += [1_000 + k * own + np.arange(own), np.arange(alike)]
        bay += [np.full(own + alike, k)]
    X, kinds, bay_of = np.concatenate(points), np.concatenate(kind), np.concatenate(bay)
    wTc = there_and_back(frames, bays * BAY_M, rng)
    seen, pixels = [], []
    for T in wTc:
        local = poses.transform(poses.inverse(T), X)
        pixel = camera.matrix @ (local / np.maximum(local[:, 2:], 1e-9)).T
        pixel = pixel[:2].T + NOISE_PX * rng.normal(size=(len(X), 2))
        inside = (local[:, 2] > 0.3) & (pixel > 0).all(axis=1)
        inside &= (pixel < [camera.width_px - 1, camera.height_px - 1]).all(axis=1)
        inside &= rng.random(len(X)) < 0.9  # a detector finds most points, not all
        index = np.flatnonzero(inside)
        seen.append(index)
        pixels.append(pixel[index])
    nothing = [
        Features(px.astype(np.float32), np.ones(len(px), np.float32), np.zeros((len(px), 4), "f4"))
        for px in pixels
    ]
    names = [f"frame-{k:06d}" for k in range(frames)]
    images = Images(names, np.arange(frames) * STEP_NS, nothing, pixels)
    pairs, misled = {}, set()
    for i in range(frames):
        for j in range(i + 1, frames):
            view, bays_off = _verified(wTc[i], wTc[j], seen[i], seen[j], kinds, bay_of)
            if view is not None:
                pairs[i, j] = view
                misled |= {(i, j)} if bays_off else set()
    return Corridor(camera, wTc, images, pairs, misled)


def _verified(wTa, wTb, first, second, kinds, bay_of) -> tuple[TwoView | None, int]:
    """What a matcher and a verification make of two images, and how many bays it is off."""
    a, b = _once(kinds[first]), _once(kinds[second])
    matches = np.array([(a[kind], b[kind]) for kind in a if kind in b], np.int32).reshape(-1, 2)
    if len(matches) < 20:
        return None, 0
    shift = bay_of[second[matches[:, 1]]] - bay_of[first[matches[:, 0]]]
    strongest = max(set(shift.tolist()), key=lambda k: (np.count_nonzero(shift == k), -abs(k)))
    kept = matches[shift == strongest]
    if len(kept) < 20 or len(kept) < 0.4 * len(matches):
        return None, 0
    # As if the second image stood so many bays further back, where it would see the first's.
    moved = wTb.copy()
    moved[0, 3] -= strongest * BAY_M
    bTa = poses.inverse(moved) @ wTa
    x, y, z = bTa[:3, 3] / max(np.linalg.norm(bTa[:3, 3]), 1e-9)
    E = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ bTa[:3, :3]
    return TwoView(kept, E, None, False), int(strongest)


def _once(kinds: npt.NDArray) -> dict[int, int]:
    """Key points by kind, of the kinds that are there once: two fail the ratio test."""
    values, place, count = np.unique(kinds, return_index=True, return_counts=True)
    return dict(zip(values[count == 1].tolist(), place[count == 1].tolist(), strict=True))


def error_m(corridor: Corridor, model) -> npt.NDArray:
    """How far each registered image is off its true place, metres, after the best Sim(3).

    Fitted without those that are far off, so that they do not drag the others along.
    """
    from ground_station.geometry.alignment import align
    from ground_station.map import colmap

    found = colmap.to_arrays(model)
    centres, truth = found.wTc[:, :3, 3], corridor.wTc[found.image_id - 1, :3, 3]
    used = np.ones(len(centres), dtype=bool)
    for _ in range(20):
        off = np.linalg.norm(align(centres[used], truth[used], True).apply(centres) - truth, axis=1)
        used = off <= max(3 * float(np.median(off)), 1e-6)
    return off
