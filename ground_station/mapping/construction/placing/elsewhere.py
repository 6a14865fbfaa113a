"""Images that would fit another place of the model as well as theirs, as where walls repeat.

Pairs that hold an image say where it is. Those that break say together where else it may be: its
key points against the landmarks that other images see there. Where walls repeat, a model may hold
an image at the wrong bay without any residual, and its rotation is right in each; only this second
hypothesis tells. As where two models are joined, one that half as many landmarks support makes the
first doubtful; and the first is wrong where it is supported by less than half of the second's.

An image joins a growing model by the few landmarks that are there then. Behind a turn, where what
is seen lies on one wall, these may leave two poses that fit; what is built on the wrong one fits
it, too, so that no residual tells and the rest of the way is bent. Once all images are there, each
is resected: solved again from all that its pairs see of the others' landmarks.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import pycolmap

from ground_station.arrays import F64, I64
from ground_station.geometry import poses
from ground_station.mapping.construction.pairs import Pair
from ground_station.mapping.construction.placing.lookalikes import BREAKS, SPEAKS
from ground_station.mapping.construction.placing.loops import SLACK_DEPTHS
from ground_station.mapping.construction.placing.merging import SECOND
from ground_station.mapping.construction.placing.placed import IN_PLACE_PX, Placed
from ground_station.mapping.sfm.robust_similarity import similarity
from ground_station.mapping.sfm.two_view import TwoView

_DRAWS = 1000
"""Of four each: where three in ten are right, three of ten thousand searches miss the pose."""
_SHOWN = 5
_AGREE = 15
"""Images; of fewer any similarity is one of most."""
_APART = 0.05
"""Of the depth: of 300 images of two real rooms those that stood right were solved again within
0.013, the wrong ones from 0.25 on, whether a landmark counts within 2.5, 4 or 8 px."""


@dataclass(frozen=True)
class Rival:
    """How many key points support an image's place, and how many the best other one."""

    here: int
    there: int

    @property
    def doubtful(self) -> bool:
        """Whether the other place is nearly as good."""
        return self.there >= SECOND * self.here

    @property
    def better(self) -> bool:
        """Whether the other place is much better."""
        return self.here <= SECOND * self.there


def rivals(model: Placed, pairs: Mapping[Pair, TwoView]) -> dict[int, Rival]:
    """The images, by index, that their broken pairs would place elsewhere, doubtful or not."""
    broken = {}
    for pair, view in pairs.items():
        if {*pair} <= model.wTc.keys():
            good, total = model.in_place(pair, view)
            if total >= SPEAKS and good <= BREAKS * total:
                broken[pair] = view
    found = {}
    for k, said in _said(model, broken).items():
        here = int(np.count_nonzero(model.landmark[k] >= 0))
        there = _elsewhere(model, k, said)
        if there >= SPEAKS:
            found[k] = Rival(here, there)
    return found


def _said(model: Placed, pairs: Mapping[Pair, TwoView]) -> dict[int, I64]:
    """What pairs say of each placed image, by index: its key points and landmarks there (N, 2).

    Several images may say the same of it, which counts once: a sample of one and the same has no
    pose.
    """
    found: dict[int, list[I64]] = {}
    for (i, j), view in pairs.items():
        if {i, j} <= model.wTc.keys():
            for mine, other, matches in ((i, j, view.matches), (j, i, view.matches[:, ::-1])):
                landmark = model.landmark[other][matches[:, 1]]
                both = np.stack([matches[:, 0], landmark], axis=1)[landmark >= 0]
                found.setdefault(mine, []).append(both.astype(np.int64))
    return {k: np.unique(np.concatenate(lists), axis=0) for k, lists in sorted(found.items())}


def _elsewhere(model: Placed, image: int, said: I64) -> int:
    """How many of an image's key points the best pose from what is `said` (N, 2) explains.

    0 where that is its own place.
    """
    if len(said) < SPEAKS:
        return 0
    points, pixel = model.position[said[:, 1]], model.pixels[image][said[:, 0]]
    try:
        solved, turn, t, inliers = cv2.solvePnPRansac(
            points, pixel, model.matrix, None,
            iterationsCount=_DRAWS, reprojectionError=IN_PLACE_PX, flags=cv2.SOLVEPNP_SQPNP,
        )  # fmt: skip
    except cv2.error:  # a sample has no pose
        return 0
    if not solved or inliers is None:
        return 0
    wTc = poses.inverse(poses.pose(cv2.Rodrigues(turn)[0], t.ravel()))
    if np.linalg.norm(wTc[:3, 3] - model.wTc[image][:3, 3]) <= SLACK_DEPTHS * model.depth:
        return 0
    return len(np.unique(said[inliers.ravel(), 0]))


def doubt(found: Mapping[int, Rival], names: Sequence[str]) -> list[str]:
    """A sentence on the images that fit two places; none where there are none."""
    doubtful = [k for k, rival in sorted(found.items()) if rival.doubtful]
    if not doubtful:
        return []
    fit = "one image fits" if len(doubtful) == 1 else f"{len(doubtful)} images fit"
    return [
        f"{fit} in another place nearly as well as in theirs, because what is seen"
        f" repeats itself: {_shown(doubtful, names)}"
    ]


def otherwise(model: Placed, others: Iterable[Placed], seed: int) -> set[int]:
    """The images, by index, that other models of the same pairs have in another place.

    Where most images of both agree, each of the rest that sees there half as many landmarks as
    here: what the pairs of the one say without a contradiction, those of the other deny.
    """
    found: set[int] = set()
    for other in others:
        both = np.array(sorted(model.wTc.keys() & other.wTc.keys()))
        here, there = (_centres(one, both) for one in (model, other))
        within = SLACK_DEPTHS * model.depth
        similar = similarity(there, here, within, seed) if len(both) >= _AGREE else None
        if similar is None:
            continue
        off = np.linalg.norm(similar.apply(there) - here, axis=1) > within
        mine, theirs = (_landmarks(one, both) for one in (model, other))
        found.update(both[off & (theirs >= SECOND * mine)].tolist())
    return found


def otherwise_doubt(found: Iterable[int], names: Sequence[str]) -> list[str]:
    """A sentence on images that other models place elsewhere; none where there are none."""
    index = sorted(found)
    if not index:
        return []
    return [
        "tried from another place, the same pairs put "
        f"{'an image' if len(index) == 1 else f'{len(index)} images'} elsewhere nearly as well: "
        f"{_shown(index, names)}"
    ]


def _centres(model: Placed, images: I64) -> F64:
    return np.array([model.wTc[k][:3, 3] for k in images.tolist()]).reshape(-1, 3)


def _landmarks(model: Placed, images: I64) -> I64:
    return np.array([np.count_nonzero(model.landmark[k] >= 0) for k in images.tolist()])


def _shown(index: Sequence[int], names: Sequence[str]) -> str:
    more = f" and {len(index) - _SHOWN} more" if len(index) > _SHOWN else ""
    return ", ".join(names[k] for k in index[:_SHOWN]) + more


def resected(model: Placed, pairs: Mapping[Pair, TwoView], seed: int) -> dict[int, F64]:
    """Poses (4, 4) of images, by index, that stand elsewhere, the best supported ones first.

    A pose is given where it explains at least half as many key points as the model's own; it may
    still be the wrong one of the two.
    """
    found = {}
    for k, both in _said(model, pairs).items():
        if len(both) < SPEAKS:
            continue
        pixel, landmark = model.pixels[k][both[:, 0]], both[:, 1]
        wTc = _resection(pixel, model.position[landmark], model.pinhole, seed)
        if wTc is None:
            continue
        apart = np.linalg.norm(wTc[:3, 3] - model.wTc[k][:3, 3])
        here, there = (
            len(np.unique(both[model.error_px(pose, landmark, pixel) < IN_PLACE_PX, 0]))
            for pose in (model.wTc[k], wTc)
        )
        if apart > _APART * model.depth and there >= max(SECOND * here, SPEAKS):
            found[k] = (there - here, wTc)
    return {k: wTc for k, (_, wTc) in sorted(found.items(), key=lambda each: -each[1][0])}


def _resection(pixel: F64, points: F64, pinhole: F64, seed: int) -> F64 | None:
    """The pose (4, 4) that most landmarks (N, 3) at pixels (N, 2) agree with."""
    camera = pycolmap.Camera(
        model="PINHOLE",
        width=round(2 * pinhole[2]),
        height=round(2 * pinhole[3]),
        params=pinhole.tolist(),
    )
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = IN_PLACE_PX
    pycolmap.set_random_seed(seed)  # the same model gives the same answer
    solved = pycolmap.estimate_and_refine_absolute_pose(pixel, points, camera, options)
    if solved is None:
        return None
    cTw = solved["cam_from_world"].matrix()
    return poses.inverse(poses.pose(cTw[:, :3], cTw[:, 3]))
