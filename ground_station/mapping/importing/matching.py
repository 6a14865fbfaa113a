"""Matches between images whose poses are known: which pairs, and which matches fit the poses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array

from ground_station.arrays import F64
from ground_station.errors import MapError
from ground_station.geometry.camera import Camera
from ground_station.geometry.epipolar import essential, sampson_px
from ground_station.mapping.construction.images import Images
from ground_station.mapping.construction.matching import mutual_matches
from ground_station.mapping.construction.verification import rules_of
from ground_station.mapping.construction.workers import Threads
from ground_station.mapping.settings import MappingSettings
from ground_station.mapping.sfm.two_view import TwoView
from ground_station.progress import Progress

_ROWS = 256


def covisible_pairs(
    points: Sequence[npt.NDArray[np.uint64]], *, least: int, most: int
) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, sorted: each image with the `most` that share most points with it.

    `points`, K arrays, are the different points that each image sees; pairs that share fewer than
    `least` are left out.
    """
    offset = np.cumsum([0, *map(len, points)])
    _, column = np.unique(np.concatenate([*points, np.empty(0, np.uint64)]), return_inverse=True)
    width = int(column.max(initial=0)) + 1
    ones = np.ones(len(column), np.int32)
    sees = csr_array((ones, column.ravel(), offset), shape=(len(points), width))
    pairs = set()
    for start in range(0, len(points), _ROWS):  # of a large model, all pairs fill the memory
        shared = (sees[start : start + _ROWS] @ sees.T).toarray()
        for i, row in enumerate(shared, start=start):
            row[i] = 0
            for j in np.argsort(-row, kind="stable")[:most].tolist():
                if row[j] >= least:
                    pairs.add((min(i, j), max(i, j)))
    return sorted(pairs)


def match(
    images: Images,
    wTc: F64,
    pairs: Sequence[tuple[int, int]],
    camera: Camera,
    settings: MappingSettings,
    threads: int,
) -> dict[tuple[int, int], TwoView]:
    """Matches of the pairs that fit the images' poses (K, 4, 4), where they are enough.

    A match is kept up to `sfm.max_error_px` off its epipolar lines: an observation further off
    would not stay in the map. Raises `MapError` when no pair has enough."""
    rules, matrix = rules_of(settings, far=False), camera.matrix

    def one(i: int, j: int) -> TwoView | None:
        first, second = images.features[i].descriptors, images.features[j].descriptors
        matches = mutual_matches(first, second, rules.ratio)
        E = essential(wTc[i], wTc[j])
        pixels = images.pinhole_px[i][matches[:, 0]], images.pinhole_px[j][matches[:, 1]]
        fits = sampson_px(*pixels, E, matrix) <= settings.sfm.max_error_px
        if fits.sum() < rules.min_inliers:
            return None
        return TwoView(matches[fits], E / np.linalg.norm(E), None, False)

    found: dict[tuple[int, int], TwoView] = {}
    with Progress("matching, pairs", len(pairs)) as progress:
        for pair, view in zip(pairs, Threads(threads).map(one, pairs), strict=True):
            if view is not None:
                found[pair] = view
            progress.step()
    if not found:
        raise MapError(
            f"no two of the {len(images.names)} images have {rules.min_inliers} matches that fit "
            "the model's poses: are these the pictures that it was made of?"
        )
    return found
