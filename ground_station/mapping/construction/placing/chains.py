"""The way of the camera: which pairs of frames are links that the frames between them confirm.

In a video a frame's place is known best from the frames beside it: they show nearly the same. Two
frames further apart in time may show two places that only look alike. So a pair is a *link* of the
chain when the frames between its two confirm it: their matches lead from the one's key points to
the other's, to the same ones that were matched directly. Between two equal doors, the key points of
the first are lost on the way before the second comes into view.

Images in no order have no chain; nothing that is judged by it says anything about them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ground_station.arrays import F64, I32, I64, Bools
from ground_station.mapping.construction.motion import best_rotation, parallax_of
from ground_station.mapping.construction.pairs import Pair
from ground_station.mapping.construction.workers import Threads
from ground_station.mapping.sfm.two_view import TwoView

REACH = 12
"""Frames; a link spans at most so many steps."""
_BRIDGE = 4
"""Frames; where the chain is broken, as by a blurred frame, so short a step needs no witness."""
_CONFIRMED = 0.5
"""Share of a link's matches with tracks at both ends, for which the two must be one: most often it
is nearly all, between places that look alike nearly none."""
_WITNESSES = 8
"""Matches that must be confirmed so."""
_BESIDE, _MOSTLY, _STRONGER = 0.4, 0.8, 1.3
"""In a video an image has so many of its most matches with the next, so many images do, and that is
so many times what two images share on average."""
_STILL_PX = 5.0
"""A point that moved less has no depth that one could tell the sign of."""
_FEWEST = 8
"""Fewer images have no order that one could tell."""


def in_order(sequence: I64, pairs: Mapping[Pair, TwoView]) -> Bools:
    """Which images are in an order that means something, (n,): a whole sequence is or is not.

    In a video an image has nearly as many matches with the next as with any, and so with each. In
    a folder of pictures it has few or none with most that follow.
    """
    n = len(sequence)
    most = np.zeros(n, dtype=np.int64)
    for (i, j), view in pairs.items():
        most[[i, j]] = np.maximum(most[[i, j]], len(view.matches))
    ordered = np.zeros(n, dtype=bool)
    for number in np.unique(sequence):
        members = np.flatnonzero(sequence == number)
        if len(members) < _FEWEST:
            continue
        strength = {pair: len(view.matches) for pair, view in pairs.items()}
        steps = [(k, k + 1) for k in members[:-1].tolist()]
        beside = [strength.get(pair, 0) for pair in steps]
        held = [
            pair in strength and strength[pair] >= _BESIDE * min(most[pair[0]], most[pair[1]])
            for pair in steps
        ]
        within = {*members.tolist()}
        total = sum(count for pair, count in strength.items() if {*pair} <= within)
        others = len(members) * (len(members) - 1) / 2 - len(steps)
        usual = (total - sum(beside)) / others
        ordered[members] = (
            sum(held) >= _MOSTLY * len(steps) and np.mean(beside) >= _STRONGER * usual
        )
    return ordered


def in_front(
    pairs: Mapping[Pair, TwoView], pixels: Sequence[F64], camera_matrix: F64, threads: int = 1
) -> dict[Pair, TwoView]:
    """The pairs that may be links, without matches that lie behind the camera.

    Along a wall of equal bays a match with the next bay lies on the right epipolar line, too; only
    it would have moved against the camera's way. `pixels` (N, 2) of each image are undistorted. A
    flow of a few pixels says nothing.
    """
    near = {(i, j): view for (i, j), view in pairs.items() if j - i <= REACH}
    items = ((view, pixels[i], pixels[j], camera_matrix) for (i, j), view in near.items())
    return dict(zip(near, Threads(threads).map(_in_front, items), strict=True))


def moved(
    pairs: Mapping[Pair, TwoView], pixels: Sequence[F64], camera_matrix: F64, error_px: float
) -> bool:
    """Whether the camera moved between the images of any pair: no turn explains what it sees.

    Where it stood still or turned, COLMAP would try each pair at each of its demands.
    """
    inverse = np.linalg.inv(camera_matrix).T

    def parallax_px(pair: Pair) -> float:
        bearings = []
        for image, matched in zip(pair, pairs[pair].matches.T, strict=True):
            rays = np.column_stack([pixels[image][matched], np.ones(len(matched))]) @ inverse
            bearings.append(rays / np.linalg.norm(rays, axis=1, keepdims=True))
        return parallax_of(best_rotation(*bearings)[1]) * float(camera_matrix[0, 0])

    return any(parallax_px(pair) > error_px for pair in pairs)


def _in_front(view: TwoView, first_px: F64, second_px: F64, camera_matrix: F64) -> TwoView:
    p = np.ascontiguousarray(first_px[view.matches[:, 0]])
    q = np.ascontiguousarray(second_px[view.matches[:, 1]])
    _, R, t, _ = cv2.recoverPose(view.essential, p, q, camera_matrix)
    far = np.column_stack([p, np.ones(len(p))]) @ np.linalg.inv(camera_matrix).T @ R.T
    far = far @ camera_matrix.T  # where it would be seen at infinity
    x = far[:, :2] / far[:, 2:]
    nearer = (camera_matrix @ t).ravel()
    flow = q - x
    against = np.sum(flow * (nearer[:2] - x * nearer[2]), axis=1) < 0
    behind = against & (np.linalg.norm(flow, axis=1) > _STILL_PX)
    return dataclasses.replace(view, matches=view.matches[~behind])


def links(
    features: Sequence[int],
    sequence: I64,
    ordered: Bools,
    pairs: Mapping[Pair, TwoView],
) -> set[Pair]:
    """The pairs that are links of a chain; `features` is the number of key points of each image.

    From the shortest steps to the longest, each is judged by the tracks that the shorter ones make.
    A track with two key points of one image is none: a match in it leads to another bay.
    """
    n = len(sequence)
    offset = np.concatenate([[0], np.cumsum(features)]).astype(np.int64)
    owner = np.repeat(np.arange(n), features)
    found: set[Pair] = set()
    edges: list[I64] = []
    image_edges: list[Pair] = []
    for step in range(1, REACH + 1):
        track = components(edges, int(offset[-1]))
        clean = _clean(track, owner, n)
        chained = components([np.array(image_edges, np.int64).reshape(-1, 2)], n)
        new: list[Pair] = []
        for i in range(n - step):
            j = i + step
            view = pairs.get((i, j))
            if view is None or not ordered[i] or sequence[i] != sequence[j]:
                continue
            ends = view.matches + offset[[i, j]]
            one, other = track[ends[:, 0]], track[ends[:, 1]]
            known = clean[one] & clean[other]
            confirmed = int(np.count_nonzero(known & (one == other)))
            confirms = confirmed >= max(_WITNESSES, _CONFIRMED * np.count_nonzero(known))
            bridges = step <= _BRIDGE and chained[i] != chained[j]
            if step == 1 or bridges or confirms:
                new.append((i, j))
                edges.append(ends)
        found.update(new)
        image_edges += new
    return found


def _clean(track: I32, owner: I64, images: int) -> Bools:
    """Which tracks, by number, have key points of more than one image, and one of each at most."""
    size = np.bincount(track)
    key, count = np.unique(track.astype(np.int64) * images + owner, return_counts=True)
    clean = size > 1
    clean[key[count > 1] // images] = False
    return clean


def components(edges: Sequence[I64], nodes: int) -> I32:
    """The connected component (nodes,) of each node of a graph; `edges` (E, 2) each."""
    ends = np.concatenate([*edges, np.empty((0, 2), np.int64)])
    graph = coo_array((np.ones(len(ends), bool), (ends[:, 0], ends[:, 1])), shape=(nodes, nodes))
    return np.asarray(connected_components(graph, directed=False)[1])
