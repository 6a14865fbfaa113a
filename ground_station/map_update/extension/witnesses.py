"""The map's own observations of what a flight saw once: COLMAP adjusts no point seen once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ground_station.arrays import Bools
from ground_station.map.model import Model
from ground_station.map.store import Map
from ground_station.mapping.sfm.models import without_points


class Witnesses:
    """One observation of each landmark that a keyframe of the map has."""

    def __init__(self, map_: Map) -> None:
        kf, camera = map_.keyframes, map_.info.camera
        self._wTc, self._names = kf.wTc, kf.names
        landmark, row = np.unique(kf.landmark, return_index=True)
        self._keyframe = np.full(len(map_.landmarks), -1, np.int64)
        self._keyframe[landmark] = np.searchsorted(kf.offset, row, side="right") - 1
        self._pixel = np.full((len(map_.landmarks), 2), np.nan)
        self._pixel[landmark] = camera.undistort_to_pinhole(kf.pixel_px[row])

    def beside(self, model: Model) -> tuple[Model, Bools]:
        """The model with keyframes that saw what it has one observation of, and which images are
        those.

        Point ids are landmarks plus 1. What no keyframe saw either is left out.
        """
        alone = np.bincount(model.point, minlength=len(model.point_id)) == 1
        unseen = np.zeros(len(alone), bool)
        unseen[alone] = self._keyframe[model.point_id[alone] - 1] < 0
        model = without_points(model, unseen)
        alone = np.flatnonzero(np.bincount(model.point, minlength=len(model.point_id)) == 1)
        landmark = model.point_id[alone] - 1
        keyframes, image = np.unique(self._keyframe[landmark], return_inverse=True)
        count, first = len(model.names), int(model.image_id.max(initial=0)) + 1
        both = replace(
            model,
            names=model.names + [self._names[k] for k in keyframes.tolist()],
            image_id=np.concatenate([model.image_id, first + np.arange(len(keyframes))]),
            wTc=np.concatenate([model.wTc, self._wTc[keyframes]]),
            image=np.concatenate([model.image, count + image.ravel()]),
            feature=np.concatenate([model.feature, np.zeros(len(alone), np.int64)]),
            point=np.concatenate([model.point, alone]),
            pixel_px=np.concatenate([model.pixel_px, self._pixel[landmark]]),
        )
        return both, np.arange(len(both.names)) >= count
