"""Images that a model holds where their own two-view geometry denies it.

Points move until matches fit, so a model that is folded, or inside out, may leave no residual. What
does not move is the rotation between two images by their matches alone. Three images confirm each
other's when their rotations close (Zach, Klopschitz and Pollefeys, "Disambiguating visual relations
using loop constraints", CVPR 2010). A pair whose landmarks are in their place, and whose confirmed
rotation the model denies, says that its two images do not belong together as they stand.
"""

from __future__ import annotations

import heapq
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from ground_station.geometry import poses
from ground_station.mapping.construction.matching import TwoView
from ground_station.mapping.construction.pairs import Pair
from ground_station.mapping.construction.placing.lookalikes import HOLDS, SPEAKS
from ground_station.mapping.construction.placing.placed import Placed
from ground_station.mapping.construction.workers import Threads

F64 = npt.NDArray[np.float64]

_STRONG = 30
"""Matches of a pair whose rotation is looked at."""
_CLOSES_DEG, _DENIES_DEG, _DENIES_CLOSURES = 2.0, 5.0, 5.0
"""Three rotations that leave no more confirm each other. A model denies one that is further off
than the second, and than so many times what half of all threes leave: 0.2 to 0.7 degrees of
RootSIFT, 1.9 of ORB. Of right models of a kitchen, a simulated hall and simulated rooms no pair of
RootSIFT's was further off, nine in ten not by 1.3 degrees; of wrong ones every tenth to second."""
_AGAINST = 20
"""A contradicted pair weighs so many that hold: in a wrong model, too, most pairs hold, in a right
one hardly any is contradicted, so that the logarithms of the two ratios are so far apart."""


@dataclass(frozen=True)
class Rotations:
    """Confirmed rotations (3, 3) of pairs, from the first image's axes to the second's.

    `denied_deg`: a model that is further off one of them denies it.
    """

    of: dict[Pair, F64]
    denied_deg: float


def rotations(
    pairs: Mapping[Pair, TwoView], pixels: Sequence[F64], camera_matrix: F64, threads: int = 1
) -> Rotations:
    """The rotations of pairs that others confirm.

    `pixels` (N, 2) of each image are undistorted. Pairs of a plane or of a camera that only turned
    have none: their essential matrix is any.
    """
    strong = {
        (i, j): view
        for (i, j), view in pairs.items()
        if not view.degenerate and len(view.matches) >= _STRONG
    }
    items = ((view, pixels[i], pixels[j], camera_matrix) for (i, j), view in strong.items())
    found = dict(zip(strong, Threads(threads).map(_rotation, items), strict=True))
    after: dict[int, set[int]] = {}
    for i, j in found:
        after.setdefault(i, set()).add(j)
    confirmed: set[Pair] = set()
    threes = [(i, j, k) for i, j in found for k in after[i] & after.get(j, set())]
    left = [_angle_deg(found[j, k] @ found[i, j], found[i, k]) for i, j, k in threes]
    for (i, j, k), closure in zip(threes, left, strict=True):
        if closure <= _CLOSES_DEG:
            confirmed |= {(i, j), (j, k), (i, k)}
    usual = float(np.median(left)) if left else 0.0
    denied_deg = max(_DENIES_DEG, _DENIES_CLOSURES * usual)
    return Rotations({pair: found[pair] for pair in found if pair in confirmed}, denied_deg)


def _rotation(view: TwoView, first_px: F64, second_px: F64, camera_matrix: F64) -> F64:
    p = np.ascontiguousarray(first_px[view.matches[:, 0]])
    q = np.ascontiguousarray(second_px[view.matches[:, 1]])
    return np.asarray(cv2.recoverPose(view.essential, p, q, camera_matrix)[1], np.float64)


def consistent_groups(
    model: Placed,
    confirmed: Rotations,
    pairs: Mapping[Pair, TwoView],
    pixels: Sequence[F64],
) -> list[set[int]]:
    """A model's images, by index, in groups that contradict themselves little; largest first.

    Matches of pairs that hold count for being together, those of pairs that are denied against it.
    A pair that does not hold says nothing: it may be of a place that looks alike. Groups grow by
    the strongest edge between two until none is left that is positive: greedy additive edge
    contraction (Keuper et al., "Efficient decomposition of image and mesh graphs by lifted
    multicuts", ICCV 2015).
    """
    weight: dict[int, dict[int, int]] = {k: {} for k in model.wTc}
    for (i, j), view in pairs.items():
        if not {i, j} <= model.wTc.keys():
            continue
        good, total = model.in_place((i, j), view, pixels)
        if total < SPEAKS or good < HOLDS * total:
            continue
        sign = 1
        if (i, j) in confirmed.of:
            here = poses.inverse(model.wTc[j])[:3, :3] @ model.wTc[i][:3, :3]
            denied = _angle_deg(here, confirmed.of[i, j]) > confirmed.denied_deg
            sign = -_AGAINST if denied else 1
        weight[i][j] = weight[j][i] = sign * len(view.matches)
    first, *others = sorted(_contracted(weight), key=lambda group: (-len(group), min(group)))
    # A stretch of images is folded: one by itself that most pairs hold was denied by chance.
    alone = {
        k
        for group in others
        if len(group) == 1
        for k in group
        if sum(w if w > 0 else w / _AGAINST for w in weight[k].values()) >= 0
    }
    return [first | alone, *(group for group in others if not group <= alone)]


def _contracted(weight: dict[int, dict[int, int]]) -> list[set[int]]:
    weight = {k: dict(near) for k, near in weight.items()}
    groups = {k: {k} for k in weight}
    heap = [(-w, i, j) for i, near in weight.items() for j, w in near.items() if i < j and w > 0]
    heapq.heapify(heap)
    while heap:
        w, i, j = heapq.heappop(heap)
        if i not in groups or j not in groups or weight[i].get(j) != -w:
            continue  # has changed since
        if len(groups[i]) < len(groups[j]):
            i, j = j, i
        groups[i] |= groups.pop(j)
        del weight[i][j]
        for k, more in weight.pop(j).items():
            if k == i:
                continue
            del weight[k][j]
            total = weight[i].get(k, 0) + more
            weight[i][k] = weight[k][i] = total
            if total > 0:
                heapq.heappush(heap, (-total, min(i, k), max(i, k)))
    return list(groups.values())


def _angle_deg(one: F64, other: F64) -> float:
    return float(np.degrees(poses.rotation_angle(one @ other.T)))
