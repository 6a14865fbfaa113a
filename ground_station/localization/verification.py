"""Does a frame show what the map says a pose would see? The check of a relocalization."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ground_station.arrays import F32, F64, Indices
from ground_station.features.extractor import Features
from ground_station.geometry.camera import Camera
from ground_station.localization.settings import WIDTH_PX, ProjectionSettings
from ground_station.localization.visibility import project, widened
from ground_station.map.modes import Modes, described
from ground_station.map.store import Landmarks

_RADIUS_PX = 5.0
"""A feature this near to where a landmark should be may be it, in a picture of `WIDTH_PX`."""
_LEAST = 0.5
"""Of these pixels, in smaller pictures: a key point's own noise does not shrink with them."""
_NEIGHBOURS = 4
"""Features that are looked at within the radius."""
_MAX_DISTANCE = 0.75
"""Of RootSIFT's descriptors: a landmark seen again, in other light, too."""
APART = 1.2
"""Descriptors farther apart are never paired for their scale's sake: by chance it is the root of 2.
"""
_SHIFTS = np.array([[4.8, 2.0], [-4.8, -2.0], [-2.0, 4.8], [2.0, -4.8]])
"""In radii: where the landmarks are certainly not: what matches there matches by chance."""
_CELLS = 16
"""In the picture's width. What is seen of one thing, a door like many, fills a few."""
_CONES = ProjectionSettings(viewing_cone=True)


def near_px(camera: Camera) -> float:
    """How near, in a camera's pictures, a feature is to where a landmark should be to be it."""
    return _RADIUS_PX * max(camera.width_px / WIDTH_PX, _LEAST)


def cells(pixel_px: F32 | F64, width_px: int) -> F64:
    """In which cells (N, 2) of a picture so wide pixels (N, 2) lie."""
    return np.asarray(pixel_px // (width_px / _CELLS))


@dataclass(frozen=True)
class Support:
    """What speaks for a pose.

    `feature` and `landmark` (N,): landmarks found again near where they project, each once;
    `expected`: landmarks that should be visible; `share` of them found; `chance`: the share found
    when the projections are shifted aside, which a wrong pose reaches as well. `evenness`:
    Student's t of the share beyond chance over cells of the picture, each counted once, as what is
    found in one cell is no independent sample (cluster-robust tests do so: Liang and Zeger,
    Biometrika 1986).
    """

    feature: Indices
    landmark: Indices
    expected: int
    share: float
    chance: float
    evenness: float = 0.0

    @property
    def significance(self) -> float:
        """By how many standard deviations more landmarks were found than chance finds."""
        by_chance = self.expected * self.chance
        deviation = np.sqrt(by_chance * (1 - self.chance) + 1)
        return float((self.expected * self.share - by_chance) / deviation)


class Witness:
    """A frame's features as a place to look landmarks up in."""

    def __init__(
        self, features: Features, camera: Camera, modes: Modes | None = None, scale: float = 1.0
    ) -> None:
        """`modes` of the map's landmarks; `scale` of descriptor distances, over RootSIFT's."""
        self.features, self.camera, self._modes = features, camera, modes
        self._radius_px, self._width_px = near_px(camera), camera.width_px
        self._farthest = min(_MAX_DISTANCE * scale, max(_MAX_DISTANCE, APART))
        self._tree = cKDTree(features.keypoints_px)

    def support(
        self, wTc: F64, landmarks: Landmarks, index: Indices, seen: Indices | None = None
    ) -> Support:
        """The support of a pose (4, 4) by the landmarks `index` (M,) that it should see.

        `seen` (N,) are landmarks that were found already, in whatever cones.
        """
        index, pixel = self._seen(wTc, landmarks, index, seen)
        if not len(index):
            return Support(np.empty(0, np.intp), np.empty(0, np.intp), 0, 0.0, 0.0)
        descriptors, mode = described(landmarks.descriptor, self._modes, index)
        feature, distance = self._near(pixel, descriptors, mode)
        found = distance < self._farthest
        chance = np.mean(
            [
                self._near(pixel + s, descriptors, mode)[1] < self._farthest
                for s in _SHIFTS * self._radius_px
            ],
            axis=0,
        )
        # A feature is one landmark: the one it looks most like.
        rows = np.flatnonzero(found)
        rows = rows[np.argsort(distance[rows], kind="stable")]
        rows = rows[np.unique(feature[rows], return_index=True)[1]]
        evenness = _evenness(cells(pixel, self._width_px), found - chance)
        share, by_chance = float(found.mean()), float(chance.mean())
        return Support(feature[rows], index[rows], len(index), share, by_chance, evenness)

    def count(
        self, wTc: F64, landmarks: Landmarks, index: Indices, seen: Indices | None = None
    ) -> int:
        """How many of the landmarks `index` (M,) are found, by chance or not."""
        index, pixel = self._seen(wTc, landmarks, index, seen)
        descriptors, mode = described(landmarks.descriptor, self._modes, index)
        return int((self._near(pixel, descriptors, mode)[1] < self._farthest).sum())

    def _seen(
        self, wTc: F64, landmarks: Landmarks, index: Indices, seen: Indices | None
    ) -> tuple[Indices, F64]:
        """Those of the landmarks `index` (M,) that a pose (4, 4) should see, and their pixels."""
        cones = widened(_CONES, landmarks, seen, wTc[:3, 3])
        projected = project(landmarks, wTc, self.camera, cones, index)
        return projected.landmark, self.camera.distort(projected.normalized)

    def _near(self, pixel_px: F64, descriptors: F32, mode: Indices | None) -> tuple[Indices, F64]:
        """For each pixel (N, 2) the nearby feature of nearest descriptor: index, distance (inf).

        Descriptors are a row each and then one for each pixel of `mode` (Q,), ascending.
        """
        _, near = self._tree.query(pixel_px, k=_NEIGHBOURS, distance_upper_bound=self._radius_px)
        if mode is not None:
            near = np.concatenate([near, near[mode]])
        there = near < len(self.features)
        own = self.features.descriptors[np.where(there, near, 0)]
        cosine = np.where(there, np.einsum("nkd,nd->nk", own, descriptors), -np.inf)
        best = cosine.argmax(axis=1)
        row = np.arange(len(best))
        value = cosine[row, best]
        distance = np.sqrt(np.maximum(2 - 2 * value, 0))
        feature = np.asarray(near[row, best], np.intp)
        if mode is not None:
            pixel = np.concatenate([np.arange(len(pixel_px)), mode])
            order = np.lexsort((distance, pixel))
            nearest = order[np.searchsorted(pixel[order], np.arange(len(pixel_px)))]
            feature, distance = feature[nearest], distance[nearest]
        return feature, np.asarray(distance, np.float64)


def _evenness(cell: F64, beyond: F64) -> float:
    """Of landmarks in cells (N, 2), each found beyond chance (N,); one cell alone tells nothing."""
    _, of, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    cells = len(count)
    if cells < 2:
        return 0.0
    excess = np.bincount(of.ravel(), beyond) / count
    # One cell more, all by chance, so that equal cells are not taken for certainty.
    deviation = np.sqrt(((excess - excess.mean()) ** 2).sum() * cells / (cells - 1) + 1)
    return float(excess.sum() / deviation)
