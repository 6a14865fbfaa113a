"""Which feature of a frame is which landmark, near where the landmarks are expected."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ground_station.localization.settings import AssociationSettings

Array = npt.NDArray[np.float64]
F32 = npt.NDArray[np.float32]
Indices = npt.NDArray[np.intp]

_BAND_PX = 40.0
"""Least height of a band of features; with twice the radius, where that is more (measured)."""

_CHUNK = 32
"""Features of a band in one product with the landmarks around them (measured)."""

_PREFIX = 128
"""Components that are compared before all are: half the work with descriptors of 256."""

_SLACK = 1e-4
"""Of the bound on the cosine, for float32's rounding."""


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
    # A second landmark farther off than this can neither win nor spoil a winner's ratio.
    farthest = min(settings.max_descriptor_distance / settings.max_ratio, 2.0)
    feature, candidate = _near_in_both(
        feature_px,
        _bounding(feature_descriptors),
        candidate_px,
        _bounding(candidate_descriptors),
        radius,
        1.0 - 0.5 * farthest**2 - _SLACK,
    )
    apart = feature_descriptors[feature] - candidate_descriptors[candidate]
    distance = np.sqrt(np.einsum("ij,ij->i", apart, apart)).astype(np.float32)
    order = np.lexsort((candidate, distance, feature))
    feature, candidate, distance = feature[order], candidate[order], distance[order]
    new = np.concatenate([[True], feature[1:] != feature[:-1]])[: len(feature)]
    wins = new & (distance < settings.max_descriptor_distance)
    if settings.max_ratio < 1.0:
        second = np.full(len(distance), np.inf, np.float32)
        second[:-1] = np.where(new[1:], np.inf, distance[1:])
        wins &= distance <= settings.max_ratio * second
    rows = np.flatnonzero(wins)
    rows = rows[np.argsort(distance[rows], kind="stable")]
    _, kept = np.unique(candidate[rows], return_index=True)
    rows = np.sort(rows[kept])
    return Associations(feature[rows], candidate[rows], distance[rows])


def _bounding(descriptors: F32) -> F32:
    """Shorter rows whose products are no smaller than those of the descriptors (N, D) themselves.

    The first components, then the norm of those left out: what these add to a product is at most
    the product of their norms (Cauchy and Schwarz).
    """
    rows = np.asarray(descriptors, np.float32)
    if rows.shape[1] <= _PREFIX:
        return rows
    rest = rows[:, _PREFIX:]
    norm = np.sqrt(np.einsum("ij,ij->i", rest, rest))
    return np.concatenate([rows[:, :_PREFIX], norm[:, None]], axis=1)


def _near_in_both(
    feature_px: Array,
    feature_rows: F32,
    candidate_px: Array,
    candidate_rows: F32,
    radius_px: float,
    least_product: float,
) -> tuple[Indices, Indices]:
    """The pairs within a radius whose rows' product is large enough, in no order.

    Features are cut into bands of y and chunks of x. The landmarks around a chunk are consecutive
    in its band's order of x, so that each chunk is one small matrix product: far cheaper than all
    products, and than gathering two rows for each pair.
    """
    height = max(2 * radius_px, _BAND_PX)
    band = np.floor(feature_px[:, 1] / height)
    features = np.lexsort((feature_px[:, 0], band))
    edges = np.concatenate([[0], np.flatnonzero(np.diff(band[features])) + 1, [len(features)]])
    by_x = np.argsort(candidate_px[:, 0])
    y = candidate_px[by_x, 1]
    pairs: list[tuple[Indices, Indices]] = []
    for begin, end in itertools.pairwise(edges.tolist()):
        top = band[features[begin]] * height
        around = by_x[(y >= top - radius_px) & (y <= top + height + radius_px)]
        mine = features[begin:end]
        x, xs = feature_px[mine, 0], candidate_px[around, 0]
        A, B = feature_rows[mine], candidate_rows[around]
        starts = np.arange(0, len(mine), _CHUNK)
        stops = np.minimum(starts + _CHUNK, len(mine))
        lefts = np.searchsorted(xs, x[starts] - radius_px, "left")
        rights = np.searchsorted(xs, x[stops - 1] + radius_px, "right")
        for start, stop, left, right in zip(
            starts.tolist(), stops.tolist(), lefts.tolist(), rights.tolist(), strict=True
        ):
            product = B[left:right] @ A[start:stop].T
            flat = np.flatnonzero(product >= least_product)
            row, column = np.divmod(flat, stop - start)
            pairs.append((mine[start + column], around[left + row]))
    feature, candidate = (np.concatenate(side) for side in zip(*pairs, strict=True))
    offset = feature_px[feature] - candidate_px[candidate]
    near = np.einsum("ij,ij->i", offset, offset) <= radius_px**2
    return feature[near], candidate[near]
