"""Which feature of a frame is which landmark, near where the landmarks are expected."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ground_station.arrays import F32, F64, Bools, Indices
from ground_station.localization.settings import AssociationSettings

_BAND_PX = 80.0
"""Least height of a band of features; four times the radius, where that is more (measured)."""

_CHUNK = 32
"""Features of a band in one product with the landmarks around them (measured)."""

_PREFIX, _WHOLE = 96, 128
"""Components that are compared before all are, of descriptors longer than 128 (measured)."""

_SLACK = 1e-4
"""Of the bound on the cosine, for float32's rounding."""

_LOW_BITS = np.uint64(0xFFFFFFFF)


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
    feature_px: F64,
    feature_descriptors: F32,
    candidate_px: F64,
    candidate_descriptors: F32,
    settings: AssociationSettings,
    radius_px: float | F64 | None = None,
    max_distance: float | None = None,
    shows: Indices | None = None,
) -> Associations:
    """Pairs features (F, 2), (F, D) with expected landmarks (L, 2), (L, D), all unit descriptors.

    Each feature takes, of the landmarks within `radius_px` of it, the one with the smallest L2
    descriptor distance, if that is below `max_descriptor_distance` and stands out from the second
    by `max_ratio`; of features that take the same landmark the nearest in descriptor keeps it.

    `radius_px` may be one for each landmark (L,); one whose radius is not finite is not paired.
    `max_distance` is asked instead of `max_descriptor_distance`.

    `shows` (L,) says which landmark, below L, each row describes, where some are described more
    than once: rows of one landmark are no rivals, the nearest counts, and `candidate` is then the
    landmark.
    """
    radius = np.asarray(settings.radius_px if radius_px is None else radius_px, np.float64)
    # NaN would spoil the largest of them; no pair is nearer than -1.
    radius = np.where(np.isfinite(radius), radius, -1.0)
    limit = np.float32(settings.max_descriptor_distance if max_distance is None else max_distance)
    if not len(feature_px) or not len(candidate_px):
        empty = np.empty(0, np.intp)
        return Associations(empty, empty, np.empty(0, np.float32))
    feature_descriptors = np.asarray(feature_descriptors, np.float32)
    candidate_descriptors = np.asarray(candidate_descriptors, np.float32)
    # A second landmark farther off than this can neither win nor spoil a winner's ratio.
    farthest = min(max(float(limit) / settings.max_ratio, 0.0), 2.0)
    feature, candidate = _near_in_both(
        feature_px,
        _bounding(feature_descriptors),
        candidate_px,
        _bounding(candidate_descriptors),
        float(radius.max()),
        1.0 - 0.5 * farthest**2 - _SLACK,
    )
    offset_px = feature_px.take(feature, axis=0) - candidate_px.take(candidate, axis=0)
    near = _near(offset_px, candidate, radius)
    feature, candidate = feature[near], candidate[near]
    apart = feature_descriptors.take(feature, axis=0)
    apart -= candidate_descriptors.take(candidate, axis=0)
    distance = np.sqrt(np.vecdot(apart, apart))
    order = _by_feature_and_distance(feature, distance, candidate)
    feature, candidate, distance = feature[order], candidate[order], distance[order]
    if shows is not None:
        candidate = shows[candidate]
        kept = _nearest_of_each(feature, candidate, shows)
        feature, candidate, distance = feature[kept], candidate[kept], distance[kept]
    new = np.concatenate([[True], feature[1:] != feature[:-1]])[: len(feature)]
    wins = new & (distance < limit)
    if settings.max_ratio < 1.0:
        second = np.full(len(distance), np.inf, np.float32)
        second[:-1] = np.where(new[1:], np.inf, distance[1:])
        wins &= distance <= settings.max_ratio * second
    rows = np.flatnonzero(wins)
    # Farthest first, of equals the later feature: the last to claim a landmark keeps it.
    key = np.sort(_ordered(distance[rows]) | rows.astype(np.uint64))[::-1]
    rows = (key & _LOW_BITS).astype(np.intp)
    owner = np.empty(len(candidate_px), np.intp)
    owner[candidate[rows]] = rows
    rows = np.sort(rows[owner[candidate[rows]] == rows])
    return Associations(feature[rows], candidate[rows], distance[rows])


def _nearest_of_each(feature: Indices, landmark: Indices, shows: Indices) -> Indices:
    """Of pairs (N,) in order of distance, the first of each feature with each landmark."""
    total = len(shows)
    doubled = np.zeros(total, bool)  # only what is described more than once is there twice
    doubled[shows[shows != np.arange(total)]] = True
    rows = np.flatnonzero(doubled[landmark])
    _, first = np.unique(feature[rows] * np.int64(total) + landmark[rows], return_index=True)
    kept = ~doubled[landmark]
    kept[rows[first]] = True
    return np.flatnonzero(kept)


def _ordered(distance: F32) -> npt.NDArray[np.uint64]:
    """Distances (N,) as upper halves of integers of the same order: their bits, none negative."""
    return np.left_shift(distance.view(np.uint32).astype(np.uint64), np.uint64(32))


def _by_feature_and_distance(feature: Indices, distance: F32, candidate: Indices) -> Indices:
    """The order (N,) by feature, then distance, then candidate; one key where none are equal."""
    key = _ordered(distance) >> np.uint64(32) | feature.astype(np.uint64) << np.uint64(32)
    order = np.argsort(key)
    key = key[order]
    if (key[1:] == key[:-1]).any():
        return np.lexsort((candidate, distance, feature))
    return order


def _bounding(descriptors: F32) -> F32:
    """Shorter rows whose products are no smaller than those of the descriptors (N, D) themselves.

    The first components, then the norm of those left out: what these add to a product is at most
    the product of their norms (Cauchy and Schwarz).
    """
    if descriptors.shape[1] <= _WHOLE:
        return descriptors
    rest = descriptors[:, _PREFIX:]
    rows = np.empty((len(descriptors), _PREFIX + 1), np.float32)
    rows[:, :_PREFIX] = descriptors[:, :_PREFIX]
    np.sqrt(np.vecdot(rest, rest), out=rows[:, _PREFIX])
    return rows


def _near_in_both(
    feature_px: F64,
    feature_rows: F32,
    candidate_px: F64,
    candidate_rows: F32,
    radius_px: float,
    least_product: float,
) -> tuple[Indices, Indices]:
    """The pairs whose rows' product is large enough, of those within a radius and some others.

    The pairs are in no order.

    Features are cut into bands of y and chunks of x. The landmarks around a chunk are consecutive
    in its band's order of x, so that each chunk is one small matrix product: far cheaper than all
    products, and than gathering two rows for each pair.
    """
    height = max(4 * radius_px, _BAND_PX)
    # Features are in the image, so that no band is as far as the clip; 16 bits are sorted quickly.
    band = np.clip(np.floor(feature_px[:, 1] / height), -30_000, 30_000).astype(np.int16)
    features = np.argsort(feature_px[:, 0])
    features = features[np.argsort(band[features], kind="stable")]
    A, x = feature_rows.take(features, axis=0), feature_px[features, 0]
    edges = np.concatenate([[0], np.flatnonzero(np.diff(band[features])) + 1, [len(features)]])
    by_x = np.argsort(candidate_px[:, 0])
    xs, ys = candidate_px.take(by_x, axis=0).T
    bands, hits, chunks, base = [], [], [], 0
    for begin, end in itertools.pairwise(edges.tolist()):
        top = float(band[features[begin]]) * height
        rows = np.flatnonzero((ys >= top - radius_px) & (ys <= top + height + radius_px))
        around = by_x[rows]
        B = candidate_rows.take(around, axis=0)
        starts = np.arange(begin, end, _CHUNK)
        stops = np.minimum(starts + _CHUNK, end)
        lefts = np.searchsorted(xs[rows], x[starts] - radius_px, "left")
        rights = np.searchsorted(xs[rows], x[stops - 1] + radius_px, "right")
        for start, stop, left, right in zip(
            starts.tolist(), stops.tolist(), lefts.tolist(), rights.tolist(), strict=True
        ):
            product = B[left:right] @ A[start:stop].T
            hits.append(np.flatnonzero(product >= np.float32(least_product)))
            chunks.append((len(hits[-1]), stop - start, start, base + left))
        bands.append(around)
        base += len(around)
    # Every chunk's flat indices at once: of its columns the features, of its rows the candidates.
    count, width, start_, left_ = np.array(chunks).T
    row, column = np.divmod(np.concatenate(hits), np.repeat(width, count))
    return (
        features[np.repeat(start_, count) + column],
        np.concatenate(bands)[np.repeat(left_, count) + row],
    )


def _near(offset_px: F64, candidate: Indices, radius_px: F64) -> Bools:
    """Whether offsets (N, 2) from candidates (N,) are within their radius."""
    radius = radius_px[candidate] if radius_px.ndim else radius_px
    near = np.einsum("ij,ij->i", offset_px, offset_px) <= np.copysign(radius**2, radius)
    return np.asarray(near)
