"""A model as those look at it who judge where its images are: by index of image and key point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ground_station.arrays import F64, I64
from ground_station.geometry import poses
from ground_station.map.model import Model
from ground_station.mapping.construction.pairs import Pair
from ground_station.mapping.sfm.two_view import TwoView

IN_PLACE_PX = 8.0
"""A landmark seen so near to where it should be is in its place; neighbours fit within 1 px."""


@dataclass(frozen=True)
class Placed:
    """Which landmark each key point of each image sees (N,), -1 for none, and where things are.

    `wTc` (4, 4) of the images that have a place; `position` (M, 3) of the landmarks; `pinhole`:
    fx, fy, cx, cy; `pixels` (N, 2) of each image's key points, undistorted, for what asks for them.
    """

    landmark: list[I64]
    wTc: dict[int, F64]
    position: F64
    pinhole: F64
    pixels: Sequence[F64] = ()

    @staticmethod
    def of(model: Model, pixels: Sequence[F64]) -> Placed:
        """Of a model and the key points (N, 2) of each image of the build, undistorted."""
        landmark = [np.full(len(mine), -1, dtype=np.int64) for mine in pixels]
        index = (model.image_id - 1).tolist()
        order = np.argsort(model.image, kind="stable")
        ends = np.searchsorted(model.image[order], np.arange(len(index) + 1))
        for k, i in enumerate(index):
            mine = order[ends[k] : ends[k + 1]]
            landmark[i][model.feature[mine]] = model.point[mine]
        places = dict(zip(index, model.wTc, strict=True))
        return Placed(landmark, places, model.position, model.pinhole, pixels)

    def among(self, images: set[int]) -> Placed:
        """The same model with these images, by index, only."""
        landmark = [
            of if k in images else np.full_like(of, -1) for k, of in enumerate(self.landmark)
        ]
        places = {k: wTc for k, wTc in self.wTc.items() if k in images}
        return replace(self, landmark=landmark, wTc=places)

    @property
    def matrix(self) -> F64:
        """The camera's (3, 3)."""
        fx, fy, cx, cy = self.pinhole
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])

    @cached_property
    def depth(self) -> float:
        """The median distance at which landmarks are seen."""
        seen = {k: of[of >= 0] for k, of in enumerate(self.landmark)}
        distances = [
            np.median(np.linalg.norm(self.position[seen[k]] - wTc[:3, 3], axis=1))
            for k, wTc in self.wTc.items()
            if len(seen[k])
        ]
        return float(np.median(distances)) if distances else 0.0

    def error_px(self, wTc: F64, landmark: I64, pixel: F64) -> F64:
        """How far landmarks (N,) are, from a pose (4, 4), off pixels (N, 2); behind it, inf."""
        local = poses.transform(poses.inverse(wTc), self.position[landmark])
        with np.errstate(divide="ignore", invalid="ignore"):
            at = local[:, :2] / local[:, 2:] * self.pinhole[:2] + self.pinhole[2:]
        error = np.linalg.norm(at - pixel, axis=1)
        return np.asarray(np.where(local[:, 2] > 0, error, np.inf))

    def in_place(self, pair: Pair, view: TwoView) -> tuple[int, int]:
        """How many landmarks of one image are where the other saw them, and of how many.

        Of a verified pair, both ways.
        """
        i, j = pair
        good = total = 0
        for one, other, matches in ((i, j, view.matches), (j, i, view.matches[:, ::-1])):
            landmark = self.landmark[one][matches[:, 0]]
            known = landmark >= 0
            seen = self.pixels[other][matches[known, 1]]
            error = self.error_px(self.wTc[other], landmark[known], seen)
            good += int(np.count_nonzero(error < IN_PLACE_PX))
            total += int(np.count_nonzero(known))
        return good, total
