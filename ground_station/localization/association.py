"""Which feature of a frame is which landmark, near where the landmarks are expected."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from ground_station.localization.settings import AssociationSettings

Array = npt.NDArray[np.float64]
F32 = npt.NDArray[np.float32]
Indices = npt.NDArray[np.intp]

_DENSE_SHARE = 0.006
"""Above this share of all pairs a matrix product is cheaper than gathering rows (measured)."""

_BLOCK = 4_000_000
"""Numbers in one block of that product: 16 MB."""


@dataclass(frozen=True)
class Associations:
    """N pairs: `feature` (N,) and `candidate` (N,) indices, `distance` (N,) of descriptors.

    No feature and no candidate is there twice; sorted by feature.
    """

    feature: Indices
    candidate: Indices
    distance: F32

    def __len__(self) -> int:
        return len(self.feature)


def associate(
    feature_px: Array,
    feature_descriptors: F32,
    candidate_px: Array,
    candidate_descriptors: F32,
    settings: AssociationSettings,
    radius_px: float | None = None,
) -> Associations:
    """Pairs features (F, 2), (F, D) with expected landmarks (L, 2), (L, D), all unit descriptors.

    Each feature takes, of the landmarks within `radius_px` of it, the one with the smallest L2
    descriptor distance, if that is below `max_descriptor_distance` and stands out from the second
    by `max_ratio`; of features that take the same landmark the nearest in descriptor keeps it.
    """
    radius = settings.radius_px if radius_px is None else radius_px
    empty = np.empty(0, np.intp)
    if not len(feature_px) or not len(candidate_px):
        return Associations(empty, empty, np.empty(0, np.float32))
    pairs = cKDTree(feature_px).sparse_distance_matrix(
        cKDTree(candidate_px), radius, output_type="ndarray"
    )
    feature, candidate = pairs["i"], pairs["j"]
    distance = _distances(feature_descriptors, candidate_descriptors, feature, candidate)
    nearest = np.full(len(feature_px), np.inf, np.float32)
    np.minimum.at(nearest, feature, distance)
    wins = (distance == nearest[feature]) & (distance < settings.max_descriptor_distance)
    rows = _first_of_each(feature, candidate, np.flatnonzero(wins))
    if settings.max_ratio < 1.0:
        others = np.ones(len(feature), bool)
        others[rows] = False
        second = np.full(len(feature_px), np.inf, np.float32)
        np.minimum.at(second, feature[others], distance[others])
        rows = rows[distance[rows] <= settings.max_ratio * second[feature[rows]]]
    rows = rows[np.argsort(distance[rows], kind="stable")]
    _, kept = np.unique(candidate[rows], return_index=True)
    rows = rows[kept]
    rows = rows[np.argsort(feature[rows])]
    return Associations(feature[rows], candidate[rows], distance[rows])


def _first_of_each(feature: Indices, candidate: Indices, rows: Indices) -> Indices:
    """Of rows, one for each feature, sorted by feature: that of the lowest candidate in a tie."""
    rows = rows[np.lexsort((candidate[rows], feature[rows]))]
    _, first = np.unique(feature[rows], return_index=True)
    return rows[first]


def _distances(a: F32, b: F32, i: Indices, j: Indices) -> F32:
    """L2 distances of unit rows a[i] and b[j], (N,): ‖a − b‖² = 2 − 2 a·b."""
    if len(i) > _DENSE_SHARE * len(a) * len(b):
        cosine = np.empty(len(i), np.float32)
        rows = max(1, _BLOCK // len(b))
        for start in range(0, len(a), rows):
            here = np.flatnonzero((i >= start) & (i < start + rows))
            cosine[here] = (a[start : start + rows] @ b.T)[i[here] - start, j[here]]
    else:
        cosine = np.einsum("ij,ij->i", a[i], b[j])
    return np.sqrt(np.maximum(2.0 - 2.0 * cosine, 0.0)).astype(np.float32)
