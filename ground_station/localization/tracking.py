"""Matched points followed from a keyframe into a frame: pyramidal KLT (Bouguet, 2001).

Lim et al. (CVPR 2012) describe only some frames and follow the matches through those in between.
Here each frame is matched with the keyframe itself and not with the frame before, so that the
tracker's drift cannot add up from frame to frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.localization.settings import TrackingSettings

Array = npt.NDArray[np.float64]
F32 = npt.NDArray[np.float32]
Indices = npt.NDArray[np.intp]
Image = npt.NDArray[np.uint8]

_EPSILON_PX = 0.02
"""A step shorter than this ends KLT's iteration: well below its noise."""

_MOST_STEPS = 20

_CELL_PX = 32
"""Side of the cells over which points are spread."""


@dataclass(frozen=True)
class Keyframe:
    """A frame whose N features are known to be landmarks.

    `image` (H, W) grey; `wTc` (4, 4); `pixel_px` (N, 2) in the (distorted) image; `landmark` (N,)
    indices into the map's landmarks; `points_m` (N, 3), where they are in the world; `sigma_px`
    (N,), the standard deviation of each when it is followed.
    """

    time_ns: int
    image: Image
    wTc: Array
    pixel_px: F32
    landmark: Indices
    points_m: Array
    sigma_px: Array

    def __len__(self) -> int:
        return len(self.landmark)


@dataclass(frozen=True)
class Tracks:
    """The N points found again: `point` (N,) indices into the keyframe's, `pixel_px` (N, 2).

    `sought` is how many were expected in view.
    """

    point: Indices
    pixel_px: F32
    sought: int


def spread_out(pixel_px: npt.ArrayLike, most: int) -> Indices:
    """Indices (M,) of at most `most` of the pixels (N, 2), best first, evenly over the image.

    Every cell gives its first before any gives its second.
    """
    pixel = np.asarray(pixel_px, np.float64).reshape(-1, 2)
    if len(pixel) <= most:
        return np.arange(len(pixel))
    cell = np.floor(pixel / _CELL_PX).astype(np.int64) @ [1 << 20, 1]
    order = np.argsort(cell, kind="stable")
    _, start, size = np.unique(cell[order], return_index=True, return_counts=True)
    rank = np.empty(len(pixel), np.int64)
    rank[order] = np.arange(len(pixel)) - np.repeat(start, size)
    return np.argsort(rank, kind="stable")[:most]


def track(
    keyframe: Keyframe, image: Image, predicted: Array, camera: Camera, settings: TrackingSettings
) -> Tracks:
    """The keyframe's points in an image (H, W) taken near the pose `predicted` (4, 4).

    Each is first looked for where the predicted pose puts it, moved by what it was off in the
    keyframe. Those that do not come back to where they started when followed back are dropped.
    """
    expected, was = (
        camera.project(poses.transform(poses.inverse(wTc), keyframe.points_m))
        for wTc in (predicted, keyframe.wTc)
    )
    guess = (expected + keyframe.pixel_px - was).astype(np.float32)
    with np.errstate(invalid="ignore"):
        inside = ((guess >= 0) & (guess <= [camera.width_px - 1, camera.height_px - 1])).all(axis=1)
        inside &= camera.uses(guess)
    point = np.flatnonzero(inside)
    if not len(point):
        return Tracks(point, np.empty((0, 2), np.float32), 0)
    start = keyframe.pixel_px[point]
    found, ok = _follow(keyframe.image, image, start, guess[point], settings)
    size = [camera.width_px - 1, camera.height_px - 1]
    ok &= ((found >= 0) & (found <= size)).all(axis=1) & camera.uses(found)
    kept = np.flatnonzero(ok)
    # Followed back from a guess that is off, or it would only confirm what it was given.
    back_guess = start[kept] + np.float32(settings.max_return_px)
    back, returned = _follow(image, keyframe.image, found[kept], back_guess, settings)
    off = np.linalg.norm(back - start[kept], axis=1)
    kept = kept[returned & (off <= settings.max_return_px)]
    return Tracks(point[kept], found[kept], len(point))


def _follow(
    before: Image, after: Image, start: F32, guess: F32, settings: TrackingSettings
) -> tuple[F32, npt.NDArray[np.bool_]]:
    """Where pixels (N, 2) went, and whether each was found (N,)."""
    if not len(start):
        return start, np.empty(0, bool)
    found, status, difference = cv2.calcOpticalFlowPyrLK(
        before,
        after,
        start,
        guess.copy(),
        winSize=(settings.window_px, settings.window_px),
        maxLevel=settings.levels - 1,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, _MOST_STEPS, _EPSILON_PX),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    # In noise a point stays where it was looked for and comes back from there: only what is around
    # it tells that it is another.
    alike = difference.ravel() <= settings.max_difference
    return np.asarray(found, np.float32), (status.ravel() == 1) & alike
