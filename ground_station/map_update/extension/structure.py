"""Frames and tracks that grow onto a map whose landmarks stay where they are.

Structure from motion in rounds: frames that the localizer knew give points, points give frames
beside them, and what is new is adjusted among the map's landmarks, which are fixed (the order of
Snavely, Seitz and Szeliski, SIGGRAPH 2006, with a map in place of the first pair).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ground_station.arrays import F64, I64, Bools, Indices
from ground_station.geometry import poses
from ground_station.localization.relocalization import pose_from_matches
from ground_station.localization.settings import RecoverySettings
from ground_station.map import landmarks
from ground_station.map.model import Model
from ground_station.map.store import Map
from ground_station.map_update.extension.frames import Anchoring, Frames
from ground_station.map_update.extension.tracks import Tracks, triangulate
from ground_station.mapping.refinement import shutter
from ground_station.mapping.settings import MappingSettings
from ground_station.mapping.sfm.adjustment import adjust_among_fixed
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


LOOSE_PX = 4.0
"""An observation may be so far off before anything was adjusted."""
_LEAST_SHARE = 0.3
"""Of a frame's known points that must agree on its pose."""
_AGAIN = 1.2
"""A frame that found no pose is tried once more when it shows so many times as many points."""
_BETWEEN = 5
"""Frames that are added between two adjustments."""
_STEADY = 12
"""A frame with fewer observations keeps its pose in an adjustment."""


class Structure:
    """The state: `wTc` (K, 4, 4) of the frames that are `posed` (K,), `position` (T, 3) of the
    tracks that are known, and `landmark` (T,), which of the map's a track shows, or -1.

    An observation's key is the landmark that it shows, or the number of landmarks plus its track's.
    """

    def __init__(
        self,
        map_: Map,
        frames: Frames,
        tracks: Tracks,
        anchoring: Anchoring,
        settings: MappingSettings,
        recovery: RecoverySettings,
        threads: int,
    ) -> None:
        self.map, self.frames, self.tracks = map_, frames, tracks
        self._anchoring, self._settings, self._recovery = anchoring, settings, recovery
        self._threads, self._witnesses = threads, Witnesses(map_)
        self.wTc, self.twist = frames.wTc.copy(), frames.twist.copy()
        self.posed: Bools = np.asarray(np.isfinite(self.wTc).all(axis=(1, 2)))
        self.position = np.full((tracks.count, 3), np.nan)
        self.landmark = np.full(tracks.count, -1, np.int64)
        camera = map_.info.camera
        self._camera = camera
        self._pinhole = np.array([camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px])
        self._depth = np.full(len(frames), np.nan)
        self._anchors = [(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.int64))]
        self._track_of = np.full(int(frames.offset[-1]), -1, np.int64)
        self._track_of[frames.offset[tracks.frame] + tracks.feature] = tracks.track

    # What is seen of the map itself

    def anchor(self, k: int, features: Indices, shown: Indices) -> None:
        """Takes features (N,) of a posed frame that are landmarks (N,)."""
        features, shown = features.astype(np.int64), shown.astype(np.int64)
        self._anchors.append((np.full(len(features), k, np.int64), features, shown))
        if len(shown):
            X = self.map.landmarks.position_m[shown] - self.wTc[k, :3, 3]
            self._depth[k] = float(np.median(X @ self.wTc[k, :3, 2]))

    def assign(self) -> None:
        """Says of each track which landmark it shows: that of most anchors, where it fits."""
        count = len(self.map.landmarks)
        frame, feature, shown = (np.concatenate(rows) for rows in zip(*self._anchors, strict=True))
        track = self._track_of[self.frames.offset[frame] + feature]
        pairs, votes = np.unique((track * count + shown)[track >= 0], return_counts=True)
        track, shown = np.divmod(pairs, max(count, 1))
        order = np.lexsort((-votes, track))
        _, first = np.unique(track[order], return_index=True)
        best = order[first]
        total = np.bincount(track, votes, self.tracks.count)
        best = best[2 * votes[best] > total[track[best]]]
        self.landmark[:] = -1
        self.landmark[track[best]] = shown[best]
        self.landmark[self._missed(self.landmark >= 0)] = -1

    def _missed(self, chosen: Bools) -> Bools:
        """Which of the chosen tracks (T,) most of their posed observations miss."""
        t = self.tracks
        rows = np.flatnonzero(self.posed[t.frame] & chosen[t.track])
        off = self._off_px(t.frame[rows], t.feature[rows], self._keys()[t.track[rows]])
        seen = np.bincount(t.track[rows], minlength=t.count)
        fits = np.bincount(t.track[rows], off <= LOOSE_PX, t.count)
        return np.asarray(2 * fits < seen)

    # Observations and where they are

    def _keys(self) -> I64:
        """The key of each track's observations (T,)."""
        count = len(self.map.landmarks)
        return np.where(self.landmark >= 0, self.landmark, count + np.arange(self.tracks.count))

    def _observations(self) -> tuple[I64, I64, I64]:
        """Frame, feature and key of all observations of tracks and of landmarks without a track."""
        t = self.tracks
        key = self._keys()[t.track]
        frame, feature, shown = (np.concatenate(rows) for rows in zip(*self._anchors, strict=True))
        alone = self._track_of[self.frames.offset[frame] + feature] < 0
        return (
            np.concatenate([t.frame, frame[alone]]),
            np.concatenate([t.feature, feature[alone]]),
            np.concatenate([key, shown[alone]]),
        )

    def _where(self, key: I64) -> F64:
        """Positions (N, 3) of keys (N,), NaN where they are not known."""
        known = np.concatenate([self.map.landmarks.position_m, self.position])
        return np.asarray(known[key])

    def _pixels(self, frame: I64, feature: I64, depth: F64) -> F64:
        """Undistorted pixels (N, 2) of observations so far away, at their frame's time."""
        node = self.frames.offset[frame] + feature
        pixel, moving = self.frames.pixel_px[node], np.any(self.twist[frame] != 0, axis=1)
        if not moving.any():
            return np.asarray(pixel)
        node, frame = node[moving], frame[moving]
        flat = (pixel[moving] - self._pinhole[2:]) / self._pinhole[:2]
        depth = np.where(np.isfinite(depth[moving]) & (depth[moving] > 0), depth[moving], 1e3)
        X = np.concatenate([flat, np.ones((len(flat), 1))], axis=1) * depth[:, None]
        camera = self.map.info.camera
        shift = shutter.shift_px(X, self.twist[frame], self.frames.row_s[node], camera)
        pixel[moving] -= np.nan_to_num(shift)
        return np.asarray(pixel)

    def _off_px(self, frame: I64, feature: I64, key: I64) -> F64:
        """Reprojection errors (N,) in posed frames; inf behind the camera, NaN of no position."""
        X = poses.in_each(self.wTc[frame], self._where(key))
        pixel = self._pixels(frame, feature, X[:, 2])
        with np.errstate(divide="ignore", invalid="ignore"):
            projected = X[:, :2] / X[:, 2:] * self._pinhole[:2] + self._pinhole[2:]
            off = np.linalg.norm(pixel - projected, axis=1)
        return np.where(X[:, 2] > 0, off, np.where(np.isnan(X[:, 2]), np.nan, np.inf))

    def model(self, gate_px: float) -> Model:
        """The posed frames and what they see within `gate_px` of where it should be.

        Image ids are frames plus 1, point ids keys plus 1; a new point has at least two
        observations and none is seen twice in a frame."""
        frame, feature, key = self._observations()
        rows = np.flatnonzero(self.posed[frame])
        frame, feature, key = frame[rows], feature[rows], key[rows]
        off = self._off_px(frame, feature, key)
        rows = np.flatnonzero(off <= gate_px)
        rows = rows[np.argsort(off[rows], kind="stable")]
        twice = key[rows] * len(self.frames) + frame[rows]
        rows = np.sort(rows[np.unique(twice, return_index=True)[1]])
        new = key[rows] >= len(self.map.landmarks)
        _, which, observations = np.unique(key[rows], return_inverse=True, return_counts=True)
        rows = rows[~new | (observations[which.ravel()] >= 2)]
        return self._as_model(frame[rows], feature[rows], key[rows])

    def _as_model(self, frame: I64, feature: I64, key: I64, depth: F64 | None = None) -> Model:
        """Observations as a model; at `depth` (N,) where their points are not known."""
        posed = np.flatnonzero(self.posed)
        keys, point = np.unique(key, return_inverse=True)
        if depth is None:
            depth = poses.in_each(self.wTc[frame], self._where(key))[:, 2]
        return Model(
            names=[self.frames.names[k] for k in posed.tolist()],
            image_id=posed + 1,
            wTc=self.wTc[posed],
            point_id=keys + 1,
            position=self._where(keys),
            image=np.searchsorted(posed, frame),
            feature=feature,
            point=point.ravel(),
            pixel_px=self._pixels(frame, feature, depth),
            camera=self._camera,
        )

    # Growing

    def triangulate(self) -> None:
        """Gives positions to the tracks that posed frames determine and that have none."""
        t = self.tracks
        unknown = (self.landmark < 0) & ~np.isfinite(self.position).all(axis=1)
        rows = np.flatnonzero(self.posed[t.frame] & unknown[t.track])
        rows = rows[np.bincount(t.track[rows], minlength=t.count)[t.track[rows]] >= 2]
        if not len(rows):
            return
        usual = float(np.nanmedian(self._depth)) if np.isfinite(self._depth).any() else np.inf
        depth = np.nan_to_num(self._depth[t.frame[rows]], nan=usual)
        key = len(self.map.landmarks) + t.track[rows]
        model = self._as_model(t.frame[rows], t.feature[rows], key, depth)
        found, good = triangulate(model, LOOSE_PX, self._settings.sfm.min_tri_angle_deg)
        tracks = found.point_id - 1 - len(self.map.landmarks)
        self.position[tracks[good]] = found.position[good]

    def adjust(self, gate_px: float) -> None:
        """Moves frames and new points to the optimum among the landmarks."""
        model, keyframe = self._witnesses.beside(self.model(gate_px))
        if not len(model.point_id):
            return
        count = len(self.map.landmarks)
        fixed = model.point_id - 1 < count
        wTc, position = adjust_among_fixed(
            model,
            fixed,
            keyframe,
            self.map.info.camera,
            loss_px=self._settings.sfm.loss_px,
            threads=self._threads,
        )
        steady = np.bincount(model.image, minlength=len(wTc)) >= _STEADY
        steady &= ~keyframe
        self.wTc[model.image_id[steady] - 1] = wTc[steady]
        self.position[model.point_id[~fixed] - 1 - count] = position[~fixed]

    def forget_doubtful(self) -> None:
        """Takes the positions of tracks that most of their posed observations miss."""
        known = (self.landmark < 0) & np.isfinite(self.position).all(axis=1)
        self.position[self._missed(known)] = np.nan

    def grow(self, on_frame: Callable[[], None] = lambda: None) -> int:
        """Poses frames that the localizer did not know, from what their neighbours see; how many.

        The frame that shows most known points comes first (Schönberger and Frahm, CVPR 2016).
        """
        tried: dict[int, int] = {}
        grown = 0
        while (k := self._most_known(tried)) is not None:
            if not self._pose(k, tried):
                continue
            grown += 1
            on_frame()
            self.anchor(k, *self._anchoring.of(k, self.wTc[k], self.twist[k]))
            self.assign()
            self.triangulate()
            if grown % _BETWEEN == 0:
                self.adjust(LOOSE_PX)
        return grown

    def _most_known(self, tried: dict[int, int]) -> int | None:
        frame, _, _ = self._known_of_unposed()
        known = np.bincount(frame, minlength=len(self.frames))
        for k, before in tried.items():
            if known[k] < _AGAIN * before:
                known[k] = 0
        k = int(known.argmax())
        return k if known[k] >= self._settings.extend.min_observations else None

    def _known_of_unposed(self) -> tuple[I64, I64, I64]:
        t, key = self.tracks, self._keys()
        known = (self.landmark >= 0) | np.isfinite(self.position).all(axis=1)
        rows = np.flatnonzero(~self.posed[t.frame] & known[t.track])
        return t.frame[rows], t.feature[rows], key[t.track[rows]]

    def _pose(self, k: int, tried: dict[int, int]) -> bool:
        """Solves a frame from its known points; notes with how many where that fails."""
        frame, feature, key = self._known_of_unposed()
        rows = np.flatnonzero(frame == k)
        pixel = self.frames.pixel_px[self.frames.offset[k] + feature[rows]]
        points = self._where(key[rows])
        found = pose_from_matches(
            points, pixel, self.map.info.camera, self._recovery, self._settings.seed
        )
        least = max(self._settings.extend.min_observations, _LEAST_SHARE * len(rows))
        if found is None or len(found[1]) < least:
            tried[k] = len(rows)
            return False
        self.wTc[k], self.posed[k] = found[0], True
        depth = (points[found[1]] - found[0][:3, 3]) @ found[0][:3, 2]
        self._depth[k] = float(np.median(depth))
        return True

    def straighten(self) -> None:
        """Gives frames that were grown the twists of their way, for the readout to be undone."""
        gap_s = self._settings.refine.keyframe_gap_s
        lost = np.isnan(self.frames.wTc[:, 0, 0])
        for flight in np.unique(self.frames.flight):
            rows = np.flatnonzero(self.posed & (self.frames.flight == flight))
            twist = shutter.twists(self.frames.time_ns[rows], self.wTc[rows], 0.0, gap_s)
            self.twist[rows[lost[rows]]] = np.nan_to_num(twist[lost[rows]])


def weak_points(model: Model, new: Bools, settings: MappingSettings) -> Bools:
    """Which points (M,) of a model no image sees, or are new and too little is known of them."""
    few = np.bincount(model.point, minlength=len(model.point_id))
    weak = (few < settings.extend.min_track) | (
        landmarks.largest_angles_deg(model) < settings.sfm.min_tri_angle_deg
    )
    return np.asarray((few == 0) | (new & weak))
