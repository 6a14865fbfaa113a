"""A frame's features against the map's landmarks, around where they are predicted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from ground_station.arrays import F32, F64, Bools, Indices
from ground_station.features.extractor import Features
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.localization.association import Associations, associate
from ground_station.localization.attempt import Conditions, Stopwatch
from ground_station.localization.blur import blurred_sigma_px, expected_blur_px
from ground_station.localization.kinematics import Kinematics, LandmarkObservations
from ground_station.localization.settings import (
    WIDTH_PX,
    LocalizerSettings,
    ProjectionSettings,
)
from ground_station.localization.verification import APART, Support, Witness
from ground_station.localization.visibility import Covisibility, LandmarkIndex, project, widened
from ground_station.map.modes import described
from ground_station.map.store import Map


def count_beyond_chance(
    distance: npt.NDArray[np.floating], by_chance: npt.NDArray[np.floating], share: float
) -> int:
    """How many of N pairs, the nearest first, chance can have made at most a `share` of.

    `distance` (N,), ascending, are of the descriptors of each pair; `by_chance` (M,), in any order,
    of the pairs that as many tries found of what is not there.
    """
    wrong = np.searchsorted(np.sort(by_chance), distance, side="right")
    kept = np.flatnonzero(wrong <= share * np.arange(1, len(distance) + 1))
    return int(kept[-1]) + 1 if len(kept) else 0


_DESCRIBED_PX = 10
"""A SIFT descriptor looks further than this around its key point, but with little weight."""

_REACH = 3.0
"""Standard deviations of a landmark's predicted pixel that a feature may be away."""


@dataclass(frozen=True)
class Described:
    """A frame's finite features; `pinhole_px` (F, 2) are without lens."""

    features: Features
    pinhole_px: F64
    taken: Conditions

    def __len__(self) -> int:
        return len(self.features)

    def showing(self, landmark: Indices) -> Described:
        """The same, where landmarks (N,) were found."""
        return replace(self, taken=replace(self.taken, recent=landmark))


def describe(features: Features, camera: Camera, taken: Conditions) -> Described:
    """Features that are finite, in what is used of the lens and as they were sent, and where they
    are without the lens."""
    finite = np.isfinite(features.keypoints_px).all(axis=1)
    finite &= np.isfinite(features.descriptors).all(axis=1)
    finite &= camera.uses(features.keypoints_px) & taken.shows(features.keypoints_px, _DESCRIBED_PX)
    features = features.where(finite)
    return Described(features, camera.undistort_to_pinhole(features.keypoints_px), taken)


@dataclass(frozen=True)
class Matches:
    """N features that are landmarks: `feature` (N,) and `landmark` (N,) indices, nearest first.

    `distance` (N,) of descriptors; `projected` landmarks were looked for.
    """

    feature: Indices
    landmark: Indices
    distance: F32
    projected: int

    def __len__(self) -> int:
        return len(self.feature)

    def where(self, keep: Bools) -> Matches:
        """Those of them that are kept, (N,)."""
        return replace(
            self,
            feature=self.feature[keep],
            landmark=self.landmark[keep],
            distance=self.distance[keep],
        )


class Matcher:
    """One map as seen through one camera."""

    def __init__(
        self,
        map_: Map,
        camera: Camera,
        settings: LocalizerSettings,
        distance_scale: float = 1.0,
    ) -> None:
        """`distance_scale` is the extractor's, by which all descriptor distances are divided."""
        self.scale = distance_scale if settings.association.scale_distances else 1.0
        limit = settings.association.max_descriptor_distance
        self._farthest = min(limit * self.scale, max(limit, APART))
        self.landmarks, self.camera, self.settings = map_.landmarks, camera, settings
        self._modes = map_.modes
        landmarks, keyframes = map_.landmarks, map_.keyframes
        self._depth_m = map_.depth_m
        self._index = LandmarkIndex(landmarks)
        self._covisibility = (
            Covisibility(len(landmarks), keyframes)
            if settings.projection.covisibility and len(keyframes)
            else None
        )
        self.radius_px = settings.association.radius_px * camera.width_px / WIDTH_PX
        """How far a landmark is looked for at most: what a prediction misses is an angle."""
        self._rolling = settings.pose.solver == "rolling"
        self._readout_s = camera.readout_s if settings.pose.rolling_shutter else 0.0

    def match(
        self,
        seen: Described,
        expected: Kinematics,
        radius_px: float | None,
        watch: Stopwatch,
        chance_share: float | None = None,
    ) -> Matches:
        """Which features are which landmarks near where `expected` projects them.

        Without a radius it follows the expected covariance, up to `self.radius_px`. `chance_share`
        is asked instead of the settings'.
        """
        settings, landmarks = self.settings, self.landmarks
        cones = self._cones(seen, expected.wTc)
        among = self._index.near(expected.wTc, self.camera, cones)
        if self._covisibility is not None and seen.taken.recent is not None:
            among = self._covisibility.covisible(seen.taken.recent, expected.wTc, among)
        projected = project(landmarks, expected.wTc, self.camera, cones, among)
        where = projected.pinhole_px
        radius: float | F64 = radius_px or self.radius_px
        if self.camera.model == "fisheye":  # or an array of ones would cost the others time
            radius = radius * self.camera.stretch(where)
        if self._rolling and len(where):
            points = landmarks.position_m[projected.landmark]
            where = self._at_rows(points, where, expected)
            if radius_px is None:
                radius = self._radius_px(points, where, expected)
        watch.lap("projection")
        rows, mode = described(landmarks.descriptor, self._modes, projected.landmark)
        shows = None
        if mode is not None:  # a landmark's modes are looked for where it is itself
            shows = np.concatenate([np.arange(len(where)), mode])

        def pair(place: Indices) -> Associations:
            """With each landmark looked for in the place of another of them (L,)."""
            place = place if shows is None else place[shows]
            return associate(
                seen.pinhole_px,
                seen.features.descriptors,
                where[place],
                rows,
                settings.association,
                radius[place] if isinstance(radius, np.ndarray) else radius,
                self._farthest,
                shows=shows,
            )

        own = np.arange(len(where))
        pairs = pair(own)
        best = np.argsort(pairs.distance, kind="stable")[: settings.pose.max_observations]
        share = chance_share or settings.association.max_chance_share
        if share < 1.0:
            # What is found of landmarks in each other's places is found by chance, where these are
            # half a picture apart.
            across = np.argsort(where[:, 0])
            place = np.empty_like(own)
            place[across] = np.roll(across, len(own) // 2)
            by_chance = pair(place).distance
            best = best[: count_beyond_chance(pairs.distance[best], by_chance, share)]
        watch.lap("association")
        return Matches(
            pairs.feature[best],
            projected.landmark[pairs.candidate[best]],
            pairs.distance[best] / np.float32(self.scale),
            len(projected.landmark),
        )

    def reach_px(self, step: F64) -> float:
        """How far a tangent step (6,) of the pose moves the picture of what lies at usual depth."""
        angle = np.linalg.norm(step[:3]) + np.linalg.norm(step[3:]) / self._depth_m
        return float(self.camera.fx_px * angle)

    def within_reach(self, expected: Kinematics) -> bool:
        """Whether landmarks are as near to where they are expected as they are looked for."""
        sigma = np.sqrt(np.diag(expected.covariance)[:6])
        return not self.reach_px(_REACH * sigma) > self.radius_px

    def doubt_px(self, points_m: F64, expected: Kinematics) -> float:
        """How far off nine in ten of landmarks (N, 3) may be from where they are expected."""
        if not len(points_m):
            return 0.0
        variance = _variance_px2(points_m, expected, self.camera)
        return float(_REACH * np.sqrt(np.quantile(variance, 0.9)))

    def support(self, seen: Described, wTc: F64, nearer_than: float = np.inf) -> Support:
        """The landmarks of less than a depth that speak for a pose (4, 4).

        Near a wrong pose features pair up as well, and agree with each other as far as they were
        looked for. Landmarks shifted aside tell how many do so by chance.
        """
        among, recent = self._among(seen, wTc, nearer_than), seen.taken.recent
        return self._witness(seen).support(wTc, self.landmarks, among, recent)

    def counts(self, seen: Described, wTc: Sequence[F64], nearer_than: float) -> list[int]:
        """How many landmarks of less than a depth are seen from poses (4, 4) that are alike."""
        witness, among = self._witness(seen), self._among(seen, wTc[0], nearer_than)
        return [witness.count(each, self.landmarks, among, seen.taken.recent) for each in wTc]

    def _witness(self, seen: Described) -> Witness:
        return Witness(seen.features, self.camera, self._modes, self.scale)

    def _among(self, seen: Described, wTc: F64, nearer_than: float) -> Indices:
        among = self._index.near(wTc, self.camera, self._cones(seen, wTc))
        return among if nearer_than == np.inf else among[self.depth(wTc, among) < nearer_than]

    def _cones(self, seen: Described, wTc: F64) -> ProjectionSettings:
        return widened(self.settings.projection, self.landmarks, seen.taken.recent, wTc[:3, 3])

    def depth(self, wTc: F64, landmark: Indices) -> F64:
        """How far before a camera at `wTc` (4, 4) landmarks (N,) are, (N,)."""
        return np.asarray((self.landmarks.position_m[landmark] - wTc[:3, 3]) @ wTc[:3, 2])

    def observations(
        self,
        pixel_px: npt.ArrayLike,
        landmark: Indices,
        sigma_px: float | F64,
        expected: Kinematics,
        taken: Conditions,
    ) -> LandmarkObservations:
        """Landmarks (N,) seen at distorted pixels (N, 2), less surely where motion blurs them.

        `sigma_px` (N,), or one for all, is without blur.
        """
        pixel, blur = np.asarray(pixel_px, np.float64), self.settings.blur
        points = np.asarray(self.landmarks.position_m[landmark], np.float64)
        sigma = np.full(len(pixel), sigma_px, np.float64)
        if blur.enabled and len(pixel):
            points_c = poses.transform(poses.inverse(expected.wTc), points)
            path = expected_blur_px(self.camera, points_c, expected.twist, taken.exposure_s)
            sigma = blurred_sigma_px(sigma, path, taken.sharpness, blur)
        floor = np.eye(3) * self.settings.pose.landmark_sigma_m**2
        pinhole = self.camera.undistort_to_pinhole(pixel)
        stretch = self.camera.stretch(pinhole)
        return LandmarkObservations(
            points,
            pinhole,
            self.row_s(pixel),
            sigma * stretch,
            self.landmarks.covariance_m2[landmark].astype(np.float64) + floor,
            stretch,
            self.landmarks.by_focal_m[landmark].astype(np.float64),
        )

    def row_s(self, pixel_px: F64) -> F64:
        """When the rows of distorted pixels (N, 2) are exposed after the frame's time, seconds."""
        last = self.camera.height_px - 1
        return np.asarray((pixel_px[:, 1] - last / 2) / last * self._readout_s)

    def _at_rows(self, points_m: F64, pinhole_px: F64, expected: Kinematics) -> F64:
        """Pinhole pixels (N, 2) moved by what the camera moves until their rows are exposed."""
        if self._readout_s == 0 or not np.any(expected.twist):
            return pinhole_px
        flow = pixel_jacobian(points_m, expected.wTc, self.camera) @ expected.twist
        row = self.camera.rows(pinhole_px)
        row_s = (row / (self.camera.height_px - 1) - 0.5) * self._readout_s
        return np.asarray(pinhole_px + flow * np.clip(row_s, -1, 1)[:, None])

    def _radius_px(self, points_m: F64, pinhole_px: F64, expected: Kinematics) -> F64:
        """How far from its prediction (N, 2) each landmark (N, 3) is looked for, by the covariance.

        The limits, as a pixel's noise, are of the picture, whose pixels the lens stretches.
        """
        settings, stretch = self.settings, self.camera.stretch(pinhole_px)
        variance = _variance_px2(points_m, expected, self.camera)
        radius = _REACH * np.sqrt(variance + 2 * (settings.pose.sigma_px * stretch) ** 2)
        least = min(settings.association.refine_radius_px or np.inf, self.radius_px)
        most = self.radius_px * stretch
        return np.clip(np.nan_to_num(radius, nan=np.inf), least * stretch, most)


def _variance_px2(points_m: F64, expected: Kinematics, camera: Camera) -> F64:
    """The variance (N,) of where points (N, 3) are seen, by the pose's covariance, both axes'."""
    J = pixel_jacobian(points_m, expected.wTc, camera)
    return np.asarray(np.einsum("nij,nij->n", J @ expected.covariance[:6, :6], J))


def pixel_jacobian(points_m: F64, wTc: F64, camera: Camera) -> F64:
    """∂(pinhole pixel)/∂ξ (N, 2, 6) of points (N, 3), ξ the right tangent of wTc; z is kept > 0."""
    x, y, z = poses.transform(poses.inverse(wTc), points_m).T
    z = np.maximum(z, 1e-3)
    u, v, none = x / z, y / z, np.zeros_like(z)
    J = np.empty((len(z), 2, 6))
    J[:, 0] = camera.fx_px * np.stack([u * v, -1 - u * u, v, -1 / z, none, u / z], axis=1)
    J[:, 1] = camera.fy_px * np.stack([1 + v * v, -u * v, -u, none, -1 / z, v / z], axis=1)
    return J
