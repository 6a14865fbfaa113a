"""Tracks that show one thing: a landmark of the map that looks otherwise, or each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from ground_station.arrays import F32, F64, I64
from ground_station.localization.settings import ProjectionSettings
from ground_station.localization.visibility import LandmarkIndex, project
from ground_station.map.model import Model
from ground_station.map.modes import described
from ground_station.map.store import Map
from ground_station.map_update.extension.frames import Frames
from ground_station.map_update.extension.structure import Structure
from ground_station.mapping.construction.placing.chains import components

_SHARE = 0.7
"""Of a point's observations that must be where a landmark projects, for it to be that landmark."""
_ALIKE = 0.5
"""L2 distance of descriptors up to which two points at one place are one."""


def observation_descriptors(model: Model, frames: Frames) -> F32:
    """The descriptor of each of a model's observations (O, D); image ids are frames plus 1."""
    dimension = frames.features[0].descriptors.shape[1]
    result = np.empty((len(model.image), dimension), np.float32)
    for k, image_id in enumerate(model.image_id.tolist()):
        rows = model.image == k
        result[rows] = frames.features[image_id - 1].descriptors[model.feature[rows]]
    return result


def mean_descriptors(descriptor: F32, group: I64, count: int) -> F32:
    """The renormalised mean (count, D) of rows (O, D) by their group (O,)."""
    mean = np.zeros((count, descriptor.shape[1]), np.float64)
    np.add.at(mean, group, descriptor)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    return mean.astype(np.float32)


def merge(
    structure: Structure, gate_px: float, radius_px: float, projection: ProjectionSettings
) -> tuple[int, int]:
    """Lets tracks be landmarks of the map, or each other, where they are at one place.

    A track whose observations are within `radius_px` of where a landmark projects, in most of its
    frames, is that landmark, however unlike it looks: that is what another light does. Of several
    the most alike is taken. Two tracks, and a track and a landmark seen from elsewhere, also need
    to look alike. Returns how many tracks became landmarks and how many others."""
    map_ = structure.map
    model = structure.model(gate_px)
    became = _same_place_in_images(structure, model, radius_px, projection)
    structure.landmark[became[:, 0]] = became[:, 1]
    model = structure.model(gate_px)
    count = len(map_.landmarks)
    new = np.flatnonzero(model.point_id - 1 >= count)
    if not len(new):
        return len(became), 0
    mean = mean_descriptors(
        observation_descriptors(model, structure.frames), model.point, len(model.point_id)
    )[new]
    track, where = model.point_id[new] - 1 - count, model.position[new]
    radius = _radius(model, radius_px)[new]
    near = _near_landmarks(map_, where, mean, radius)
    structure.landmark[track[near[:, 0]]] = near[:, 1]
    apart = np.ones(len(new), bool)
    apart[near[:, 0]] = False
    track, where, mean, radius = track[apart], where[apart], mean[apart], radius[apart]
    label = _alike_groups(where, mean, radius)
    _, first = np.unique(label, return_index=True)
    into = np.arange(structure.tracks.count)
    into[track] = track[first][label]
    structure.tracks = replace(structure.tracks, track=into[structure.tracks.track])
    return len(became) + len(near), len(track) - len(first)


def _same_place_in_images(
    structure: Structure, model: Model, radius_px: float, projection: ProjectionSettings
) -> I64:
    """Rows (track, landmark) of tracks that are seen where landmarks project."""
    map_, count = structure.map, len(structure.map.landmarks)
    camera, index = map_.info.camera, LandmarkIndex(map_.landmarks)
    pairs = [np.empty((0, 2), np.int64)]
    for k, wTc in enumerate(model.wTc):
        rows = np.flatnonzero((model.image == k) & (model.point_id[model.point] - 1 >= count))
        shown = project(
            map_.landmarks, wTc, camera, projection, index.near(wTc, camera, projection)
        )
        if not len(rows) or not len(shown.landmark):
            continue
        tree = cKDTree(shown.pinhole_px)
        near = tree.query_ball_point(model.pixel_px[rows], radius_px)
        point = np.repeat(model.point[rows], [len(each) for each in near])
        landmark = shown.landmark[np.array([i for each in near for i in each], np.int64)]
        pairs.append(np.stack([point, landmark], axis=1))
    found, votes = np.unique(np.concatenate(pairs), axis=0, return_counts=True)
    observations = np.bincount(model.point, minlength=len(model.point_id))
    found = found[(votes >= 2) & (votes >= _SHARE * observations[found[:, 0]])]
    if not len(found):
        return np.empty((0, 2), np.int64)
    points, which = np.unique(found[:, 0], return_inverse=True)
    mean = mean_descriptors(
        observation_descriptors(model, structure.frames), model.point, len(model.point_id)
    )
    distance = distance_to_landmarks(map_, mean[found[:, 0]], found[:, 1])
    order = np.lexsort((distance, which.ravel()))
    best = found[order[np.unique(which.ravel()[order], return_index=True)[1]]]
    return np.stack([model.point_id[points] - 1 - count, best[:, 1]], axis=1)


def distance_to_landmarks(map_: Map, descriptor: F32, landmark: I64) -> F64:
    """L2 distances (N,) of rows (N, D) from the nearest descriptor of their landmarks (N,)."""
    known, mode = described(map_.landmarks.descriptor, map_.modes, landmark)
    distance = np.linalg.norm(descriptor - known[: len(descriptor)], axis=1)
    if mode is not None:
        further = np.linalg.norm(descriptor[mode] - known[len(descriptor) :], axis=1)
        np.minimum.at(distance, mode, further)
    return np.asarray(distance, np.float64)


def _radius(model: Model, radius_px: float) -> F64:
    """How far a pixel distance is at each point (M,), by the mean distance of its cameras."""
    away = np.linalg.norm(model.wTc[model.image, :3, 3] - model.position[model.point], axis=1)
    count = len(model.point_id)
    mean = np.bincount(model.point, away, count) / np.maximum(
        np.bincount(model.point, minlength=count), 1
    )
    return np.asarray(radius_px * mean / model.pinhole[:2].mean())


def _near_landmarks(map_: Map, where: F64, mean: F32, radius: F64) -> I64:
    """Rows (point, landmark) of points (N, 3) near landmarks that look alike."""
    tree = cKDTree(map_.landmarks.position_m)
    near = tree.query_ball_point(where, radius)
    point = np.repeat(np.arange(len(where)), [len(each) for each in near])
    landmark = np.array([i for each in near for i in each], np.int64)
    if not len(point):
        return np.empty((0, 2), np.int64)
    distance = distance_to_landmarks(map_, mean[point], landmark)
    order = np.lexsort((distance, point))
    order = order[np.unique(point[order], return_index=True)[1]]
    order = order[distance[order] <= _ALIKE]
    return np.stack([point[order], landmark[order]], axis=1)


def _alike_groups(where: F64, mean: F32, radius: F64) -> I64:
    """Labels (N,) of points (N, 3) such that near and alike ones have the same."""
    pairs = cKDTree(where).query_pairs(float(radius.max(initial=0.0)), output_type="ndarray")
    a, b = pairs.T
    near = np.linalg.norm(where[a] - where[b], axis=1) <= np.minimum(radius[a], radius[b])
    alike = np.linalg.norm(mean[a] - mean[b], axis=1) <= _ALIKE
    a, b = a[near & alike], b[near & alike]
    return components([np.stack([a, b], axis=1)], len(where)).astype(np.int64)
