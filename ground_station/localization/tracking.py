"""Matched points followed from a keyframe into a frame: pyramidal KLT (Bouguet, 2001).

Lim et al. (CVPR 2012) describe only some frames and follow the matches through those in between.
Here each frame is matched with the keyframe itself and not with the frame before, so that the
tracker's drift cannot add up from frame to frame. KLT takes for granted that a point keeps its
brightness, which exposure, gain, lamps and their flicker change: it gets evenly lit pictures.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt

from ground_station.arrays import F32, F64, U8, Bools, Indices
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.localization.attempt import Conditions
from ground_station.localization.settings import WIDTH_PX, TrackingSettings

_EPSILON_PX = 0.02
"""A step shorter than this ends KLT's iteration: well below its noise."""

_MOST_STEPS = 20

_BASIN = 0.12
"""Of the window's side: so far off a guess may be for one level to bring it home, and twice as far
for each level more. Of corners of the sample's flight, guessed aside at random and with a sensor's
noise, one level finds 99.8 % at 2.5 px with a window of 21 px, 98 % at 3.5 and 87 % at 5; two find
all but 0.04 % at 5 px, and three all at 10 px."""

_FINE_PX = 9
"""Side of the window by which a point's place is read off in the end. Two simulated flights at 640
px: 0.42 and 0.38 cm, 0.48 and 0.41 without. Alone it would lose points at 4 m/s, and in noise."""

_MORE_ALIKE = 0.7
"""Of the larger window's difference: the smaller one's must be less, or nothing in the larger moves
otherwise, and it has less noise."""

_FEW = 0.5
"""Of the points sought: with fewer the prediction was off, as after a bump, or the view is covered.
In each frame of the sample's flight 88 % or more are found."""

_FEWEST = 8
"""Points that tell a homography: twice as many as it needs."""

_STRAIGHT_PX = 0.5
"""So far a window's corners may be from where they were, in the median, before it is warped: at
0.8 px nothing is gained of a simulated small circle (0.51 cm, 0.47 with 0.5, 0.3 or 0)."""

_CELL_PX = 32
"""Side of the cells over which points are spread."""

_REDUCTION = 4
"""Light is measured in a picture this much smaller: it changes slowly from pixel to pixel."""

_AROUND_PX = 84
"""Side of what a pixel's contrast is measured in: KLT's window (21 px) at its pyramid's top (4:1).

What is smaller takes away what the top goes by: with 20 px a guess may be off by 10 px, with 84 by
20 to 30 as in the picture itself; with 44 a flight of 4 m/s was lost at 15 Hz. Of a lamp's 100 Hz a
picture that is read out within 1/30 s shows 3.3 periods: the light is nearly a slope across.
"""

_NOISE = 4.0
"""Standard deviation, grey levels, that is no contrast yet: a sensor's noise and a codec's."""

_CONTRAST = 32.0
"""Standard deviation, grey levels, of an evenly lit picture: four of them find room in 8 bits."""


@dataclass(frozen=True)
class Keyframe:
    """A frame whose N features are known to be landmarks.

    `image` (H, W) grey; `wTc` (4, 4); `pixel_px` (N, 2) in the (distorted) image; `landmark` (N,)
    indices into the map's landmarks; `points_m` (N, 3), where they are in the world; `sigma_px`
    (N,), the standard deviation of each when it is followed. The best come first.
    """

    time_ns: int
    image: U8
    wTc: F64
    pixel_px: F32
    landmark: Indices
    points_m: F64
    sigma_px: F64

    def __len__(self) -> int:
        return len(self.landmark)

    def first(self, count: int) -> Keyframe:
        """With so many points at most: the best of each part of the picture."""
        if len(self) <= count:
            return self
        kept = spread_out(self.pixel_px, count)
        return replace(
            self,
            pixel_px=self.pixel_px[kept],
            landmark=self.landmark[kept],
            points_m=self.points_m[kept],
            sigma_px=self.sigma_px[kept],
        )

    @cached_property
    def even(self) -> U8:
        """Its picture (H, W), evenly lit."""
        return evenly_lit(self.image)


@dataclass(frozen=True)
class Tracks:
    """The N points found again: `point` (N,) indices into the keyframe's, `pixel_px` (N, 2).

    `sought` is how many were expected in view.
    """

    point: Indices
    pixel_px: F32
    sought: int


def evenly_lit(image: U8) -> U8:
    """A grey picture (H, W) with the same mean and contrast around each of its pixels.

    What is as bright as before times a gain plus an offset, be they of exposure, light or row,
    looks the same again, and nearly so after a tone curve. No exposure need be told.
    Jin, Favaro and Soatto (ICCV 2001) solve for gain and offset of each window as they follow it.
    """
    height, width = image.shape
    small = (max(1, width // _REDUCTION), max(1, height // _REDUCTION))
    around = (_AROUND_PX // _REDUCTION, _AROUND_PX // _REDUCTION)
    mean, square = (
        cv2.blur(cv2.resize(power, small, interpolation=cv2.INTER_AREA).astype(np.float32), around)
        for power in (image, cv2.multiply(image, image, dtype=cv2.CV_16U))
    )
    factor = _CONTRAST / (np.sqrt(np.maximum(square - mean * mean, 0)) + _NOISE)
    by, plus = (cv2.resize(x, (width, height)) for x in (factor, 128 - mean * factor))
    scaled = cv2.multiply(image, by, dtype=cv2.CV_32F)
    return np.asarray(cv2.add(scaled, plus, dtype=cv2.CV_8U), np.uint8)


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
    keyframe: Keyframe,
    image: U8,
    predicted: F64,
    camera: Camera,
    settings: TrackingSettings,
    doubt_px: float = np.inf,
    taken: Conditions = Conditions(),  # noqa: B008  # frozen
) -> Tracks:
    """The keyframe's points in an image (H, W) taken near the pose `predicted` (4, 4).

    Each is first looked for where the predicted pose puts it, moved by what it was off in the
    keyframe, whose picture is warped as that pose sees it. Those that do not come back to where
    they started when followed back are dropped, and those that fall into what the image, as it was
    `taken`, does not show.
    `doubt_px` is how far off the prediction may put them: they are looked for with no more levels
    of the pyramid than that needs, as each costs as much as the finest; with all where that finds
    fewer than half of them.
    """
    wide_px = round(settings.window_px * min(1.0, camera.width_px / WIDTH_PX))
    settings = replace(settings, window_px=max(wide_px, min(_FINE_PX, settings.window_px)))
    few = _levels(settings, doubt_px)
    tracks = _track(keyframe, image, predicted, camera, few, taken)
    if few.levels < settings.levels and len(tracks.point) < _FEW * tracks.sought:
        return _track(keyframe, image, predicted, camera, settings, taken)
    return tracks


def _track(
    keyframe: Keyframe,
    image: U8,
    predicted: F64,
    camera: Camera,
    settings: TrackingSettings,
    taken: Conditions,
) -> Tracks:
    expected, was = (
        camera.project(poses.transform(poses.inverse(wTc), keyframe.points_m))
        for wTc in (predicted, keyframe.wTc)
    )
    guess = (expected + keyframe.pixel_px - was).astype(np.float32)
    with np.errstate(invalid="ignore"):
        seen = _in_picture(guess, camera) & taken.shows(guess, settings.window_px // 2)
    point = np.flatnonzero(seen)
    if not len(point):
        return Tracks(point, np.empty((0, 2), np.float32), 0)
    start = keyframe.pixel_px[point]
    even = evenly_lit(image)
    template, start = _bent(keyframe.even, start, guess[point], settings.window_px)
    found, ok, unlike = _follow(template, even, start, guess[point], settings)
    ok &= _in_picture(found, camera) & taken.shows(found, settings.window_px // 2)
    kept = np.flatnonzero(ok)
    aside = _levels(settings, float(np.hypot(settings.max_return_px, settings.max_return_px)))
    kept = kept[_returns(even, template, found[kept], start[kept], aside)]
    # By what is next to them alone: a window of which a part lies farther away than the point is
    # drawn along by both.
    fine = replace(settings, window_px=min(_FINE_PX, settings.window_px), levels=1)
    closer, there, less = _follow(template, even, start[kept], found[kept], fine)
    there &= _returns(even, template, closer, start[kept], fine)
    there &= (less < _MORE_ALIKE * unlike[kept]) & _in_picture(closer, camera)
    found[kept[there]] = closer[there]
    return Tracks(point[kept], found[kept], len(point))


def _in_picture(pixel_px: F32, camera: Camera) -> Bools:
    """Whether pixels (N, 2) lie in the picture, where it is used (N,)."""
    last = [camera.width_px - 1, camera.height_px - 1]
    inside = ((pixel_px >= 0) & (pixel_px <= last)).all(axis=1)
    return np.asarray(inside & camera.uses(pixel_px))


def _returns(after: U8, before: U8, found: F32, start: F32, settings: TrackingSettings) -> Bools:
    """Whether pixels (N, 2) that were found come back to where they started (N,).

    They are followed from a guess that is off, or it would only confirm what it was given.
    """
    aside = start + np.float32(settings.max_return_px)
    back, returned, _ = _follow(after, before, found, aside, settings)
    near = np.linalg.norm(back - start, axis=1) <= settings.max_return_px
    return np.asarray(returned & near)


def _bent(template: U8, start: F32, guess: F32, window_px: int) -> tuple[U8, F32]:
    """A keyframe's picture (H, W) and its points (N, 2), seen from where the frame is taken.

    KLT only shifts its windows. Where a wall is come nearer or turned to, what lies in them is
    another: the picture is warped by the homography that takes most points to their guesses within
    a window, if that bends a window at all.
    """
    if len(start) < _FEWEST:
        return template, start
    homography, _ = cv2.findHomography(start, guess, cv2.RANSAC, window_px)
    if homography is None or not np.isfinite(homography).all():
        return template, start
    half = window_px // 2
    corners = half * np.array([[0, 0], [-1, -1], [1, -1], [-1, 1], [1, 1]], np.float32)
    square = (start[:, None] + corners).reshape(1, -1, 2)
    there = cv2.perspectiveTransform(square, homography).reshape(-1, 5, 2)
    sides = there[:, 1:] - there[:, :1] - corners[1:]
    if not _STRAIGHT_PX < np.median(np.linalg.norm(sides, axis=2)) < half:
        return template, start
    height, width = template.shape
    warped = cv2.warpPerspective(
        template, homography, (width, height), borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(warped, np.uint8), np.ascontiguousarray(there[:, 0], np.float32)


def _levels(settings: TrackingSettings, doubt_px: float) -> TrackingSettings:
    """With as many levels as a guess that may be so far off needs, up to those set."""
    levels, reach_px = 1, _BASIN * settings.window_px
    while levels < settings.levels and not doubt_px <= reach_px:  # also when it is not a number
        levels, reach_px = levels + 1, 2 * reach_px
    return replace(settings, levels=levels)


def _follow(
    before: U8, after: U8, start: F32, guess: F32, settings: TrackingSettings
) -> tuple[F32, Bools, F32]:
    """Where pixels (N, 2) went, whether each was found (N,), and how unlike its window is (N,)."""
    if not len(start):
        return start, np.empty(0, bool), np.empty(0, np.float32)
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
    unlike = np.asarray(difference, np.float32).ravel()
    alike = unlike <= settings.max_difference * _CONTRAST
    return np.asarray(found, np.float32), (status.ravel() == 1) & alike, unlike
