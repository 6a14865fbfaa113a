"""Where the landmarks of the other images put an image, whatever place it has among them.

An image joins a growing model by the few landmarks that are there then. Behind a turn, where what
is seen lies on one wall, these may leave two poses that fit; what is built on the wrong one fits
it, too, so that no residual tells and the rest of the way is bent. Once all images are there, each
is solved again from all that its pairs see of the others' landmarks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pycolmap

from ground_station.arrays import F64, I64
from ground_station.geometry import poses
from ground_station.mapping.construction.pairs import Pair
from ground_station.mapping.construction.placing.lookalikes import SPEAKS
from ground_station.mapping.construction.placing.merging import SECOND
from ground_station.mapping.construction.placing.placed import IN_PLACE_PX, Placed
from ground_station.mapping.sfm.two_view import TwoView

_APART = 0.05
"""Of the depth: of 300 images of two real rooms those that stood right were solved again within
0.013, the wrong ones from 0.25 on, whether a landmark counts within 2.5, 4 or 8 px."""


def elsewhere(
    model: Placed, pairs: Mapping[Pair, TwoView], pixels: Sequence[F64], seed: int
) -> dict[int, F64]:
    """Poses (4, 4) of images, by index, that stand elsewhere, the best supported ones first.

    `pixels` (N, 2) are each image's undistorted key points. A pose is given where it explains at
    least half as many key points as the model's own; it may still be the wrong one of the two.
    """
    seen: dict[int, list[I64]] = {k: [] for k in model.wTc}
    for (i, j), view in pairs.items():
        if {i, j} <= seen.keys():
            for mine, other, matches in ((i, j, view.matches), (j, i, view.matches[:, ::-1])):
                landmark = model.landmark[other][matches[:, 1]]
                both = np.stack([matches[:, 0], landmark], axis=1)[landmark >= 0]
                seen[mine].append(both.astype(np.int64))
    found = {}
    for k, lists in seen.items():
        both = np.unique(np.concatenate([*lists, np.empty((0, 2), np.int64)]), axis=0)
        if len(both) < SPEAKS:
            continue
        pixel, landmark = pixels[k][both[:, 0]], both[:, 1]
        wTc = _solved(pixel, model.position[landmark], model.pinhole, seed)
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


def _solved(pixel: F64, points: F64, pinhole: F64, seed: int) -> F64 | None:
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
