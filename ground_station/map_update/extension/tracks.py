"""Features of several frames that are the same thing: tracks of matches, and their points."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from ground_station.arrays import F64, I32, I64, Bools, Indices
from ground_station.map import landmarks
from ground_station.map.model import Model
from ground_station.map.store import MapInfo
from ground_station.map_update.extension.frames import Frames
from ground_station.mapping.construction.matching import verify
from ground_station.mapping.construction.pairs import Pair
from ground_station.mapping.construction.placing.chains import components
from ground_station.mapping.construction.verification import alike, rules_of
from ground_station.mapping.construction.workers import Threads
from ground_station.mapping.settings import MappingSettings
from ground_station.mapping.sfm.models import without_observations
from ground_station.mapping.sfm.two_view import TwoView
from ground_station.progress import Progress

_SHARED = 30
"""Landmarks of the map that two frames far apart in time must both see to be compared."""


@dataclass(frozen=True)
class Tracks:
    """O observations of T tracks: frame[o] shows track[o] as its feature[o]; sorted by track.

    No track is there twice in a frame.
    """

    frame: I64
    feature: I64
    track: I64
    count: int


def pairs_to_match(
    frames: Frames, seen: Sequence[Indices], landmarks: int, settings: MappingSettings
) -> list[Pair]:
    """Frames (i, j), i < j, to compare: those that follow each other, and that share landmarks.

    `seen` holds, for each frame, the landmarks of the map that it was found to show.
    """
    count, near = len(frames), settings.extend.neighbours
    pairs = {
        (i, j)
        for i in range(count)
        for j in range(i + 1, min(i + 1 + near, count))
        if frames.flight[i] == frames.flight[j]
    }
    offset = np.cumsum([0, *map(len, seen)])
    every = np.concatenate([*seen, np.empty(0, np.intp)])
    shows = sparse.csr_matrix(
        (np.ones(len(every), np.int32), every, offset), shape=(count, landmarks)
    )
    shared = np.asarray((shows @ shows.T).todense())
    for i, row in enumerate(shared):
        row[i] = 0
        order = np.argsort(-row, kind="stable")
        far = [j for j in order.tolist() if (min(i, j), max(i, j)) not in pairs]
        best = itertools.islice((j for j in far if row[j] >= _SHARED), settings.extend.similar)
        pairs.update((min(i, j), max(i, j)) for j in best)
    return sorted(pairs)


def match_frames(
    frames: Frames,
    pairs: Sequence[Pair],
    info: MapInfo,
    settings: MappingSettings,
    threads: int,
) -> list[tuple[Pair, I32]]:
    """Matches (N, 2) of the pairs that share a geometry, verified as in a build."""
    rules = rules_of(replace(settings, features=info.features), far=False)
    pixels = [frames.pixel_px[a:b] for a, b in itertools.pairwise(frames.offset.tolist())]

    def one(i: int, j: int) -> TwoView | None:
        matches = alike(frames.features[i].descriptors, frames.features[j].descriptors, rules)
        return verify(pixels[i], pixels[j], matches, info.camera.matrix, rules)

    verified = []
    with Progress("matching, pairs", len(pairs)) as progress:
        for pair, view in zip(pairs, Threads(threads).map(one, pairs), strict=True):
            if view is not None:
                verified.append((pair, view.matches))
            progress.step()
    return verified


def joined(offset: I64, verified: Sequence[tuple[Pair, I32]]) -> Tracks:
    """Tracks of matches; `offset` (K + 1,) counts the features of the frames before each.

    Where a track has two features in one frame, it is not seen in that frame.
    """
    edges = [offset[[i, j]] + matches for (i, j), matches in verified]
    label = components(edges, int(offset[-1]))
    node = np.unique(np.concatenate([np.empty((0, 2), np.int64), *edges]))
    frame = np.searchsorted(offset, node, side="right") - 1
    _, where, times = np.unique(
        label[node].astype(np.int64) * len(offset) + frame, return_inverse=True, return_counts=True
    )
    alone = times[where.ravel()] == 1
    node, frame = node[alone], frame[alone]
    names, track = np.unique(label[node], return_inverse=True)
    order = np.lexsort((frame, track.ravel()))
    return Tracks(
        frame[order].astype(np.int64),
        (node - offset[frame])[order].astype(np.int64),
        track.ravel()[order].astype(np.int64),
        len(names),
    )


_LEAST_CONDITION = 1e-6
"""Rays whose normal equations are worse conditioned are parallel."""


def nearest_to_rays(model: Model) -> F64:
    """Where each point's rays come nearest to each other (M, 3); NaN where they are parallel.

    The point of least squared distance from all its rays (the midpoint of two, for two).
    """
    count = len(model.point_id)
    fx, fy, cx, cy = model.pinhole
    flat = (model.pixel_px - [cx, cy]) / [fx, fy]
    rays = np.concatenate([flat, np.ones((len(flat), 1))], axis=1)
    rays = np.einsum("oij,oj->oi", model.wTc[model.image, :3, :3], rays)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None]
    centre = model.wTc[model.image, :3, 3]
    A, b = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(A, model.point, across)
    np.add.at(b, model.point, np.einsum("oij,oj->oi", across, centre))
    size = np.linalg.eigvalsh(A)
    found = size[:, 0] > _LEAST_CONDITION * np.maximum(size[:, 2], 1e-12)
    position = np.full((count, 3), np.nan)
    position[found] = np.linalg.solve(A[found], b[found][..., None])[..., 0]
    return position


def triangulate(model: Model, gate_px: float, min_angle_deg: float) -> tuple[Model, Bools]:
    """The model with positions from its observations, and which points (M,) are well determined.

    Twice, the second time without the observations that miss the first positions by more than
    `gate_px`; well determined is what two observations agree on with a large enough angle between
    them."""
    first = replace(model, position=nearest_to_rays(model))
    inner = without_observations(first, ~_agreeing(first, gate_px))
    result = replace(model, position=nearest_to_rays(inner))
    agreeing = without_observations(result, ~_agreeing(result, gate_px))
    good = np.bincount(agreeing.point, minlength=len(result.position)) >= 2
    good &= landmarks.largest_angles_deg(agreeing) >= min_angle_deg
    return result, np.asarray(good & np.isfinite(result.position).all(axis=1))


def _agreeing(model: Model, gate_px: float) -> Bools:
    residual = np.linalg.norm(landmarks.residuals_px(model), axis=1)
    return np.asarray(residual <= gate_px)  # NaN is not
