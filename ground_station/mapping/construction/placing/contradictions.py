"""Images that a model holds where their own two-view geometry denies it.

Points move until matches fit, so a model that is folded, or inside out, may leave no residual. What
does not move is the rotation between two images by their matches alone. Three images confirm each
other's when their rotations close (Zach, Klopschitz and Pollefeys, "Disambiguating visual relations
using loop constraints", CVPR 2010). A pair whose landmarks are in their place, and whose confirmed
rotation the model denies at the cost of its matches, says that its two images do not belong
together as they stand.
"""

from __future__ import annotations

import heapq
from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from ground_station.arrays import F64
from ground_station.geometry import poses
from ground_station.geometry.epipolar import essential, sampson_px
from ground_station.mapping.construction.pairs import Pair
from ground_station.mapping.construction.placing.lookalikes import HOLDS, SPEAKS
from ground_station.mapping.construction.placing.placed import Placed
from ground_station.mapping.construction.workers import Threads
from ground_station.mapping.sfm.two_view import TwoView

_STRONG = 30
"""Matches of a pair whose rotation is looked at."""
_CLOSES_DEG, _DENIES_DEG = 2.0, 5.0
"""Three rotations that leave no more confirm each other. A model denies one that is further off
than the second."""
_DENIES_RATIO = 2.0
"""A model denies a pair only where it leaves the pair's matches so many times further from their
epipolar lines than the pair's own geometry does. A few matches, of a plane or at a distance, do not
tell a rotation from a step: of right models of simulated rooms such pairs are off by up to 34
degrees, and the model fits their matches as well (ratios of 0.3 to 1.25); of a bent one of a walk,
two to forty times worse (half of them more than six times)."""
_AGAINST = 20
"""A contradicted pair weighs so many that hold: in a wrong model, too, most pairs hold, in a right
one hardly any is contradicted, so that the logarithms of the two ratios are so far apart."""


def rotations(
    pairs: Mapping[Pair, TwoView], pixels: Sequence[F64], camera_matrix: F64, threads: int = 1
) -> dict[Pair, F64]:
    """Rotations (3, 3) of pairs that others confirm, from the first's axes to the second's.

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
    for i, j, k in threes:
        if _angle_deg(found[j, k] @ found[i, j], found[i, k]) <= _CLOSES_DEG:
            confirmed |= {(i, j), (j, k), (i, k)}
    return {pair: found[pair] for pair in found if pair in confirmed}


def _rotation(view: TwoView, first_px: F64, second_px: F64, camera_matrix: F64) -> F64:
    p = np.ascontiguousarray(first_px[view.matches[:, 0]])
    q = np.ascontiguousarray(second_px[view.matches[:, 1]])
    return np.asarray(cv2.recoverPose(view.essential, p, q, camera_matrix)[1], np.float64)


def consistent_groups(
    model: Placed, confirmed: Mapping[Pair, F64], pairs: Mapping[Pair, TwoView]
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
        good, total = model.in_place((i, j), view)
        if total < SPEAKS or good < HOLDS * total:
            continue
        denied = (i, j) in confirmed and _denied(model, (i, j), confirmed[i, j], view)
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


def _denied(model: Placed, pair: Pair, rotation: F64, view: TwoView) -> bool:
    """Whether the model has the pair at another rotation, and their matches worse for it."""
    i, j = pair
    here = poses.inverse(model.wTc[j])[:3, :3] @ model.wTc[i][:3, :3]
    if _angle_deg(here, rotation) <= _DENIES_DEG:
        return False
    matched = model.pixels[i][view.matches[:, 0]], model.pixels[j][view.matches[:, 1]]
    theirs = essential(model.wTc[i], model.wTc[j])
    own, held = (np.median(sampson_px(*matched, E, model.matrix)) for E in (view.essential, theirs))
    return bool(held > _DENIES_RATIO * own)


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
