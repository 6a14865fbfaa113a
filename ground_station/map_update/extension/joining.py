"""The map with what has grown onto it: new keyframes, new landmarks, new modes of old ones."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from ground_station.arrays import F32, I64
from ground_station.map import landmarks, store
from ground_station.map.descriptors import joined
from ground_station.map.model import Model
from ground_station.map.modes import with_modes
from ground_station.map_update.extension.frames import Frames
from ground_station.map_update.extension.looks import Looks
from ground_station.mapping.sfm.models import without_points


@dataclass(frozen=True)
class Grown:
    """What joins: `model`, whose image ids are frames plus 1; `landmark` (P,), which of the map's
    each of its points is, or -1; `descriptor` (O, D) of its observations; and new modes."""

    model: Model
    landmark: I64
    descriptor: F32
    looks: Looks


def join(map_: store.Map, grown: Grown, frames: Frames) -> store.Map:
    """The map in memory; what was in it keeps its place, its number and its descriptor."""
    lm, model, looks = map_.landmarks, grown.model, grown.looks
    old = grown.landmark[model.point] >= 0
    shown = grown.landmark[model.point[old]]
    again = landmarks.seen_again(lm, shown, model.wTc[model.image[old], :3, 3])
    new = _new_landmarks(map_, grown)
    fields: dict[str, Any] = {
        field.name: joined(lm.descriptor, new.descriptor)
        if field.name == "descriptor"
        else np.concatenate([getattr(again, field.name), getattr(new, field.name)])
        for field in dataclasses.fields(store.Landmarks)
    }
    number = grown.landmark.copy()
    number[number < 0] = len(lm) + np.arange(int((number < 0).sum()))
    modes = map_.modes
    if len(looks.landmark):
        modes = with_modes(modes, looks.landmark, looks.descriptor)
    return store.Map(
        info=store.MapInfo(**vars(map_.info)),
        landmarks=store.Landmarks(**fields),
        keyframes=_keyframes(map_, model, number, frames),
        modes=modes,
    )


def _new_landmarks(map_: store.Map, grown: Grown) -> store.Landmarks:
    """Those that the map did not have, with the numbers that follow its own."""
    model, is_old = grown.model, grown.landmark >= 0
    mine = ~is_old[model.point]
    alone = without_points(model, is_old)
    first = int(map_.landmarks.id.max(initial=0)) + 1
    alone = dataclasses.replace(alone, point_id=first + np.arange(len(alone.point_id)))
    made = landmarks.make_landmarks(alone, grown.descriptor[mine])
    if not len(made):
        return made
    # The landmarks of the map, which are fixed, take part in telling how good an observation is.
    residual = landmarks.residuals_px(model)
    freedom = 2 * len(residual) - 3 * len(alone.point_id) - 6 * len(model.names)
    sigma = float(np.sqrt(np.sum(residual**2) / max(freedom, 1)))
    covariance = landmarks.covariances(alone, sigma)
    return dataclasses.replace(made, covariance_m2=covariance.astype(np.float32))


def _keyframes(map_: store.Map, model: Model, number: I64, frames: Frames) -> store.Keyframes:
    kf, camera = map_.keyframes, map_.info.camera
    order = np.lexsort((model.feature, model.image))
    counts = np.bincount(model.image, minlength=len(model.names))
    rays = (model.pixel_px[order] - model.pinhole[2:]) / model.pinhole[:2]
    return store.Keyframes(
        names=kf.names + model.names,
        time_ns=np.concatenate([kf.time_ns, frames.time_ns[model.image_id - 1]]),
        wTc=np.concatenate([kf.wTc, model.wTc]),
        offset=np.concatenate([kf.offset, kf.offset[-1] + np.cumsum(counts)]).astype(np.int64),
        landmark=np.concatenate([kf.landmark, number[model.point[order]]]).astype(np.int32),
        pixel_px=np.concatenate([kf.pixel_px, camera.distort(rays)]).astype(np.float32),
    )
