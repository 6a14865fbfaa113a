"""A cache's entries as plain bytes, and back: nothing in them is executed or believed unseen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ground_station.features.extractor import Features
from ground_station.mapping.sfm.two_view import TwoView

FEATURES, PAIR = 1, 2

_MOST_ROWS = 1 << 20
_MOST_COLUMNS = 1 << 14
_DEGENERATE, _PLANE = 1, 2
"""Flags of a pair, in `columns`: it gives no baseline; a homography is kept with it."""
_NOTHING = -1
"""The rows of a pair that was compared and shares no geometry."""
_MATRIX = 9 * 8


class EntryError(ValueError):
    """An entry whose bytes are not what it says."""


@dataclass(frozen=True)
class Entry:
    """One row: what kind of thing, its shape, and its bytes, little-endian.

    Of features, `rows` N and `columns` D: N key points (2 float32), N scores (float32), N
    descriptors (D float32). Of a pair, `rows` K, or -1 where the images share no geometry, and
    `columns` flags: K matches (2 int32), the essential matrix and perhaps a homography (9 float64).
    """

    kind: int
    rows: int
    columns: int
    data: bytes


def of_features(features: Features) -> Entry:
    """An image's features as an entry."""
    parts = (features.keypoints_px, features.scores, features.descriptors)
    data = b"".join(np.ascontiguousarray(part, "<f4").tobytes() for part in parts)
    return Entry(FEATURES, len(features), features.descriptors.shape[1], data)


def to_features(entry: Entry) -> Features:
    """The features in an entry; raises `EntryError`."""
    n, d = entry.rows, entry.columns
    if entry.kind != FEATURES or not (0 <= n <= _MOST_ROWS and 0 < d <= _MOST_COLUMNS):
        raise EntryError("not an image's features")
    if len(entry.data) != 4 * n * (3 + d):
        raise EntryError("too short or too long")
    values = np.frombuffer(entry.data or bytes(4), "<f4").astype(np.float32)[: n * (3 + d)]
    if not np.isfinite(values).all():
        raise EntryError("not finite")
    pixels, scores, descriptors = np.split(values, [2 * n, 3 * n])
    return Features(pixels.reshape(n, 2), scores, descriptors.reshape(n, d))


def of_view(view: TwoView | None) -> Entry:
    """A pair's geometry, or that it has none, as an entry."""
    if view is None:
        return Entry(PAIR, _NOTHING, 0, b"")
    parts = [np.ascontiguousarray(view.matches, "<i4"), np.ascontiguousarray(view.essential, "<f8")]
    if view.homography is not None:
        parts.append(np.ascontiguousarray(view.homography, "<f8"))
    flags = _DEGENERATE * view.degenerate + _PLANE * (view.homography is not None)
    return Entry(PAIR, len(view.matches), flags, b"".join(part.tobytes() for part in parts))


def to_view(entry: Entry, features: tuple[int, int]) -> TwoView | None:
    """The geometry in an entry of a pair of images with so many features; raises `EntryError`."""
    k, flags = entry.rows, entry.columns
    if entry.kind != PAIR or k == 0 or not (_NOTHING <= k <= _MOST_ROWS and 0 <= flags <= 3):
        raise EntryError("not a pair's geometry")
    if k == _NOTHING:
        if entry.data or flags:
            raise EntryError("too long")
        return None
    if len(entry.data) != 8 * k + _MATRIX * (2 if flags & _PLANE else 1):
        raise EntryError("too short or too long")
    matches = np.frombuffer(entry.data, "<i4", 2 * k).astype(np.int32).reshape(k, 2)
    if (matches < 0).any() or (matches >= features).any():
        raise EntryError("it matches features that the images do not have")
    matrices = np.frombuffer(entry.data, "<f8", offset=8 * k).astype(np.float64).reshape(-1, 3, 3)
    if not np.isfinite(matrices).all():
        raise EntryError("not finite")
    homography = matrices[1] if flags & _PLANE else None
    return TwoView(matches, matrices[0], homography, bool(flags & _DEGENERATE))
