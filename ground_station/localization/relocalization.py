"""The camera's pose from the whole map, without a guess.

Places that look like the frame, matches within each, P3P in locally optimised RANSAC, and then a
check that asks the other way round: does the frame show what the map says this pose would see?
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from ground_station.arrays import F32, F64, Indices
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.localization.matching import Described, pixel_jacobian
from ground_station.localization.retrieval import PlaceIndex
from ground_station.localization.settings import RecoverySettings, StartSettings
from ground_station.localization.verification import Witness
from ground_station.map.modes import described
from ground_station.map.store import Map

_BLOCK = 8_000_000
"""Descriptor products held at once: 32 MB."""


@dataclass(frozen=True)
class Relocalization:
    """A pose (4, 4) and its inliers: `feature` (N,) and `landmark` (N,) indices.

    `significance`: by how many standard deviations more landmarks are where they should be than
    chance puts there. `open_by`: the position's standard deviation by the inliers alone, over
    their depth. `doubt`: why it is not believed by itself, "" where it is.
    """

    wTc: F64
    feature: Indices
    landmark: Indices
    significance: float = 0.0
    open_by: float = 0.0
    doubt: str = ""


def match_all(
    descriptors: F32, landmarks: F32, max_ratio: float, mode: Indices | None = None
) -> tuple[Indices, Indices]:
    """Mutual nearest neighbours of unit descriptors (F, D) and (L, D) that pass the ratio test.

    Returns indices (N,) and (N,). The ratio is of L2 distances, over each feature's two nearest.
    The last Q of L rows may be `mode` (Q,), ascending: further descriptors of landmarks before
    them. A landmark is then as near as the nearest of its descriptors.
    """
    modes = 0 if mode is None else len(mode)
    count, total = len(descriptors), len(landmarks) - modes
    if count == 0 or total < 2:
        return np.empty(0, np.intp), np.empty(0, np.intp)
    best, best_cos = np.empty(count, np.intp), np.empty(count, np.float32)
    second_cos = np.empty(count, np.float32)
    back, back_cos = np.zeros(total, np.intp), np.full(total, -np.inf, np.float32)
    rows = max(1, _BLOCK // (total + modes))
    for start in range(0, count, rows):
        cosine = descriptors[start : start + rows] @ landmarks.T
        if mode is not None:
            cosine = _nearest_of_each(cosine, total, mode)
        here = np.arange(len(cosine))
        nearest = cosine.argmax(axis=1)
        column = cosine.argmax(axis=0)
        value = cosine[column, np.arange(total)]
        better = value > back_cos
        back[better], back_cos[better] = column[better] + start, value[better]
        best[start + here], best_cos[start + here] = nearest, cosine[here, nearest]
        cosine[here, nearest] = -np.inf
        second_cos[start + here] = cosine.max(axis=1)
    d1, d2 = (np.sqrt(np.maximum(2 - 2 * c, 0)) for c in (best_cos, second_cos))
    feature = np.flatnonzero((back[best] == np.arange(count)) & (d1 < max_ratio * d2))
    return feature, best[feature]


def _nearest_of_each(cosine: F32, total: int, mode: Indices) -> F32:
    """Products (F, total) with the nearest of each landmark's rows, from those with all rows."""
    nearest = cosine[:, :total]
    turn = np.arange(len(mode)) - np.searchsorted(mode, mode)
    for k in range(int(turn.max(initial=-1)) + 1):  # a landmark's modes one after the other
        rows = np.flatnonzero(turn == k)
        nearest[:, mode[rows]] = np.maximum(nearest[:, mode[rows]], cosine[:, total + rows])
    return nearest


def spread(pixel_px: npt.ArrayLike, camera: Camera) -> float:
    """RMS distance of pixels (N, 2) from their centre, over the image's diagonal; 0 when none."""
    pixels = np.asarray(pixel_px, dtype=np.float64)
    if not len(pixels):
        return 0.0
    offset = pixels - pixels.mean(axis=0)
    rms = np.sqrt((offset * offset).sum(axis=1).mean())
    return float(rms / np.hypot(camera.width_px, camera.height_px))


_PROPOSED = 2.0
"""Times what an inlier of a find may miss by: a pose from three landmarks misses the others by more
than one from all does. In a map of 20 images of a kitchen a frame's right pose had 17 of 69 matches
within 3 px, and a wrong one 18; within 6 px the right one had the most, 21."""


def pose_from_matches(
    points_m: F64, pinhole_px: F64, camera: Camera, settings: RecoverySettings, seed: int
) -> tuple[F64, Indices] | None:
    """wTc (4, 4) that most points (N, 3) at undistorted pixels (N, 2) agree with, and which do.

    P3P in RANSAC with MAGSAC's score and local optimisation; None where nothing is found.
    """
    params = cv2.UsacParams()
    params.threshold = _PROPOSED * settings.max_reprojection_px
    params.maxIterations = settings.max_iterations
    params.confidence = 0.9999
    params.randomGeneratorState = seed
    params.sampler = cv2.SAMPLING_UNIFORM
    params.score = cv2.SCORE_METHOD_MAGSAC
    params.loMethod = cv2.LOCAL_OPTIM_INNER_LO
    params.loIterations = 10
    params.loSampleSize = 30
    try:
        found, _, rvec, tvec, inliers = cv2.solvePnPRansac(
            points_m, pinhole_px, camera.matrix, None, params=params
        )
    except cv2.error:
        return None
    if not found or inliers is None or not np.isfinite(np.r_[rvec.ravel(), tvec.ravel()]).all():
        return None
    wTc = poses.inverse(poses.pose(cv2.Rodrigues(rvec)[0], tvec.ravel()))
    return wTc, np.asarray(inliers.ravel(), np.intp)


_RETRIEVED, _PLACES, _MIN_SHARED = 24, 3, 0.15
"""Keyframes retrieved, places tried, the share of landmarks that makes keyframes one place."""
_WIDE = 30_000
"""Landmarks that are searched at last, those of the most alike keyframes; it bounds the time."""
_NEIGHBOURS = 12
"""Keyframes that saw most of a found pose's inliers: what they saw should be seen."""
_MIN_MATCHED = 12
"""Inliers of RANSAC that are worth the check that follows."""
_SAME = 0.05
"""Two poses nearer than this share of the map's depth are one. Nor may the shear of a rolling
shutter, which nobody knows of a first frame, move the position by more of the inliers' depth."""
_RIVAL = 0.5
"""A pose elsewhere with this share of the best one's inliers leaves the place undecided."""


class _Search:
    """One frame in search of its pose."""

    def __init__(
        self, seen: Described, map_: Map, camera: Camera, settings: RecoverySettings, seed: int,
        scale: float,
    ) -> None:  # fmt: skip
        self.seen, self.camera, self.settings, self.seed = seen, camera, settings, seed
        self.landmarks, self.modes = map_.landmarks, map_.modes
        self.witness = Witness(seen.features, camera, map_.modes, scale)

    def propose(self, candidates: Indices) -> tuple[F64, Indices] | str:
        """wTc and its inliers from matches with some landmarks (M,), or why there is none."""
        settings, lm = self.settings, self.landmarks
        rows, mode = described(lm.descriptor, self.modes, candidates)
        feature, row = match_all(self.seen.features.descriptors, rows, settings.max_ratio, mode)
        if len(feature) < _MIN_MATCHED:
            return f"{len(feature)} matches"
        found = pose_from_matches(
            lm.position_m[candidates[row]],
            self.seen.pinhole_px[feature],
            self.camera,
            settings,
            self.seed,
        )
        if found is None:
            return "no pose explains the matches"
        wTc, inliers = found
        if len(inliers) < max(_MIN_MATCHED, settings.min_inlier_share * len(feature)):
            return f"{len(inliers)} inliers of {len(feature)} matches"
        return wTc, candidates[row[inliers]]

    def confirm(self, wTc: F64, seen: Indices, expected: Indices) -> Relocalization | str:
        """The pose refined over all landmarks that should be seen, beside those that RANSAC took
        for `seen` (N,), or why it is refused."""
        settings = self.settings
        support = self.witness.support(wTc, self.landmarks, expected, seen)
        if len(support.feature) >= _MIN_MATCHED:
            wTc = self._refine(wTc, support.feature, support.landmark)
            support = self.witness.support(wTc, self.landmarks, expected, seen)
        near = self._residual_px(wTc, support.feature, support.landmark)
        good = near < settings.max_reprojection_px
        feature, landmark = support.feature[good], support.landmark[good]
        beyond, doubt = support.share - support.chance, ""
        if len(feature) < settings.min_inliers:
            doubt = f"{len(feature)} of {support.expected} landmarks where they should be"
        elif beyond < settings.min_excess or support.evenness < settings.min_evenness:
            doubt = (
                f"{support.share:.0%} of {support.expected} landmarks found, "
                f"{support.chance:.0%} by chance"
            )
        if len(feature) < _MIN_MATCHED or support.significance < settings.min_significance:
            return doubt or f"{support.significance:.1f} sigma more landmarks than by chance"
        if spread(self.seen.features.keypoints_px[feature], self.camera) < settings.min_spread:
            return "the inliers lie in one corner of the image"
        wTc = self._refine(wTc, feature, landmark)
        open_by = self._sigma(wTc, landmark)
        return Relocalization(wTc, feature, landmark, support.significance, open_by, doubt)

    def _sigma(self, wTc: F64, landmark: Indices) -> float:
        """Standard deviation of the position over the inliers' depth."""
        points = self.landmarks.position_m[landmark]
        depth = poses.transform(poses.inverse(wTc), points)[:, 2]
        u, v = pixel_jacobian(points, wTc, self.camera).swapaxes(0, 1)
        try:
            covariance = np.linalg.inv((u.T @ u + v.T @ v) / _sigma_px(self.settings) ** 2)
        except np.linalg.LinAlgError:
            return float("inf")
        return float(np.sqrt(np.trace(covariance[3:, 3:])) / np.median(depth))

    def _residual_px(self, wTc: F64, feature: Indices, landmark: Indices) -> F64:
        points = poses.transform(poses.inverse(wTc), self.landmarks.position_m[landmark])
        projected = points @ self.camera.matrix.T
        seen = self.seen.pinhole_px[feature]
        offset = projected[:, :2] / projected[:, 2:] - seen
        return np.asarray(np.linalg.norm(offset, axis=1) / self.camera.stretch(seen), np.float64)

    def _refine(self, wTc: F64, feature: Indices, landmark: Indices) -> F64:
        """Least squares over the matches (Levenberg-Marquardt)."""
        cTw = poses.inverse(wTc)
        rvec, tvec = cv2.solvePnPRefineLM(
            self.landmarks.position_m[landmark], self.seen.pinhole_px[feature],
            self.camera.matrix, None, cv2.Rodrigues(cTw[:3, :3])[0], cTw[:3, 3:].copy(),
        )  # fmt: skip
        return poses.inverse(poses.pose(cv2.Rodrigues(rvec)[0], np.ravel(tvec)))


class Relocalizer:
    """Finds frames in one map, whose keyframes are indexed once."""

    def __init__(
        self,
        map_: Map,
        camera: Camera,
        settings: RecoverySettings,
        seed: int,
        scale: float = 1.0,
        turn_deg_s: float = StartSettings.turn_deg_s,
    ) -> None:
        """`scale` of the descriptors' distances, over RootSIFT's; `turn_deg_s` as a camera may
        turn, one deviation."""
        self._map, self._scale = map_, scale
        self._same_m = _SAME * map_.depth_m
        self._camera, self._settings, self._seed = camera, settings, seed
        shear_px = camera.fx_px * np.deg2rad(turn_deg_s) * camera.readout_s
        self._most_open = _SAME * _sigma_px(settings) / shear_px if shear_px else np.inf
        self._index: PlaceIndex | None = None
        if len(map_.keyframes):
            self._index = PlaceIndex(map_.landmarks, map_.keyframes, seed, map_.modes)

    def candidates(self, seen: Described) -> list[Relocalization] | str:
        """The poses that a frame may have anywhere in the map, or the reason why there is none.

        Those with a doubt are to be believed only where something else says the same.

        The most alike keyframes are matched together, so that only what is unlike all the rest
        counts, and when that fails (in a building that repeats itself) place by place, and then as
        much of the map as can be searched at once: in other light the most alike may all be wrong.
        A map without keyframes is one place. The same frame gives the same answer.
        """
        if not len(seen):
            return "no features"
        search = _Search(seen, self._map, self._camera, self._settings, self._seed, self._scale)
        if self._index is None:
            return _only_place(search)
        alike = self._index.ranked(seen.features.descriptors)
        ranked = alike[:_RETRIEVED]
        together = self._try(self._index, search, self._index.seen_by(ranked))
        found = []
        if not isinstance(together, str):
            if not together.doubt:
                return [together]
            found, together = [together], together.doubt
        for place in self._index.places(ranked, _PLACES, _MIN_SHARED):
            alone = self._try(self._index, search, self._index.seen_by(place))
            if not isinstance(alone, str):
                found.append(alone)
        if all(one.doubt for one in found):
            wide = self._try(self._index, search, self._index.first_seen(alike, _WIDE))
            if not isinstance(wide, str):
                found.append(wide)
        return found or f"{together} in the most alike places"

    def alone(self, found: list[Relocalization]) -> Relocalization | str:
        """Which of some candidates is the place, where nothing else is known of it, or why none.

        Of two places that fit nearly as well, neither is believed.
        """
        sure = [each for each in found if not each.doubt]
        if not sure:
            return f"{found[0].doubt} in the most alike places"
        best = _undisputed(sure, self._same_m)
        if isinstance(best, str) or best.open_by <= self._most_open:
            return best
        return f"the inliers leave the position open by {best.open_by:.1%} of their depth"

    def _try(self, index: PlaceIndex, search: _Search, candidates: Indices) -> Relocalization | str:
        proposed = search.propose(candidates)
        if isinstance(proposed, str):
            return proposed
        wTc, inliers = proposed
        return search.confirm(wTc, inliers, index.seen_by(index.seeing(inliers, _NEIGHBOURS)))


def _sigma_px(settings: RecoverySettings) -> float:
    """An inlier's standard deviation: half of what it may miss by."""
    return settings.max_reprojection_px / 2


def _undisputed(found: list[Relocalization], same_m: float) -> Relocalization | str:
    """The best of several poses unless another, elsewhere, is nearly as good."""
    found.sort(key=lambda one: -len(one.feature))
    best = found[0]
    for other in found[1:]:
        apart_m = float(np.linalg.norm(other.wTc[:3, 3] - best.wTc[:3, 3]))
        if apart_m > same_m and len(other.feature) > _RIVAL * len(best.feature):
            return "two places fit alike"
    return best


def _only_place(search: _Search) -> list[Relocalization] | str:
    everything = np.arange(len(search.landmarks))
    proposed = search.propose(everything)
    if isinstance(proposed, str):
        return proposed
    found = search.confirm(*proposed, everything)
    return found if isinstance(found, str) else [found]
