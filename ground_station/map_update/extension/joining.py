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
from ground_station.map.store import Map
from ground_station.map_update.extension.frames import Frames
from ground_station.map_update.extension.merging import distance_to_landmarks, mean_descriptors
from ground_station.mapping.settings import MappingSettings
from ground_station.mapping.sfm.models import without_points

_MOST_SPREAD = 0.6
"""RMS distance of a mode's observations from their mean, beyond which they are not one look."""
_FEWEST = 3
"""Frames that must have seen a mode: two may share what hid the landmark."""


@dataclass(frozen=True)
class Looks:
    """New modes: `landmark` (N,) and `descriptor` (N, D).

    `seen` landmarks of the map were seen; `near` of their observations were as the map knows them,
    `far` were not; `full` landmarks had as many modes as they may."""

    landmark: I64
    descriptor: F32
    seen: int
    near: int
    far: int
    full: int


def new_looks(map_: Map, landmark: I64, descriptor: F32, settings: MappingSettings) -> Looks:
    """The modes that observations of landmarks (O,) with descriptors (O, D) give.

    An observation is far when its descriptor is further from all that the landmark has than
    `mode_distance` and than `mode_spreads` times the landmark's spread. Far ones, of at least
    three frames and alike among themselves, become a mode: their mean. What is near
    changes nothing, so that a landmark goes on to look in its first light as it did.
    """
    wanted, lm = settings.extend, map_.landmarks
    distance = distance_to_landmarks(map_, descriptor, landmark)
    limit = np.maximum(wanted.mode_distance, wanted.mode_spreads * lm.spread[landmark])
    far = np.flatnonzero(distance > limit)
    shown, group, count = np.unique(landmark[far], return_inverse=True, return_counts=True)
    group = group.ravel()
    mean = mean_descriptors(descriptor[far], group, len(shown))
    square = np.sum((descriptor[far] - mean[group]) ** 2, axis=1)
    spread = np.sqrt(np.bincount(group, square, len(shown)) / np.maximum(count, 1))
    good = (count >= _FEWEST) & (spread <= _MOST_SPREAD)
    had = np.zeros(len(lm), np.int64)
    if map_.modes is not None:
        had = np.bincount(map_.modes.landmark, minlength=len(lm))
    room = had[shown] < wanted.max_modes
    return Looks(
        landmark=shown[good & room],
        descriptor=mean[good & room],
        seen=len(np.unique(landmark)),
        near=len(landmark) - len(far),
        far=len(far),
        full=int((good & ~room).sum()),
    )


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
