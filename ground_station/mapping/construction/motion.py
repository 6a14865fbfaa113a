"""How far a camera came from frame to frame, and how sharp each frame is: figures for `keyframes`.

Points of an anchor frame are followed by pyramidal KLT (Bouguet, 2001) in small pictures. The
rotation that fits their bearings best (Kabsch, Acta Cryst. A32, 1976; reweighted, so that what
moves or was followed wrongly does not pull it) is the turn; what it leaves between the bearings is
the parallax. A wall straight ahead cannot tell a step sideways from a turn: either of them counts.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from ground_station.arrays import F32, F64, I64, U8, Bools
from ground_station.geometry.camera import Camera
from ground_station.mapping.settings import KeyframeSettings

_WIDTH_PX = 320
_TILES = 3, 4
_POINTS = 10
"""At most, in each of so many rows and columns of tiles: a fine pattern does not take them all."""
_APART_PX = 9
_QUALITY = 0.02
_PATCH_PX = 7
_LEAST_CONTRAST = 3.0
"""Grey levels; a corner whose surroundings vary less is noise on a blank wall."""
_WINDOW = (13, 13)
_LEVELS = 3
_MOST_STEPS = 15
_RETURN_PX = 1.0
"""A point followed there and back that ends further from where it began is lost."""
_LEAST_POINTS = 12
_LEAST_SHARE = 0.45
"""Of an anchor's points; where fewer are found, the frames are taken not to show the same."""
_COHERENT = 3.0
"""Points that a rotation leaves more than so many due parallaxes apart count as not found: in
another scene some corners always seem to be followed, but not together."""
_PATIENCE = 5
"""So many frames in a row may be unlike all before (blur, a hand, a flash) before it is a cut."""
_BLURRED = 0.85
"""Less sharp than this share of the usual, a frame loses points that are still in view, and becomes
an anchor only when it is high time."""
_FADES = 0.97
"""What is usual falls so from frame to frame, until a sharper one comes."""
_HIGH_TIME = 1.6
_LEAST_VARIANCE = 1.0
_ROUNDS = 4
_PARALLAX_QUANTILE = 75.0
"""The rotation may fit one wall alone; a quarter of the points elsewhere tell of a step."""
_NOTHING: F32 = np.empty((0, 2), np.float32)


@dataclass(frozen=True)
class Figures:
    """N frames of one input, in its order.

    `index` (N,) counts in the input, `time_ns` (N,); `motion` (N,), never falling, grows by 1 from
    where a keyframe stands to where the next is due; `sharpness` (N,), the amplitude of a picture's
    gradients over that of its contrast; `segment` (N,) numbers the stretches between cuts;
    `followed` (N,) is False for frames that could not be tied to those around them.
    """

    index: I64
    time_ns: I64
    motion: F64
    sharpness: F64
    segment: I64
    followed: Bools

    def __len__(self) -> int:
        return len(self.index)


@dataclass
class _Row:
    """One frame's figures while they are found; `motion` is as far as is known by then."""

    index: int
    time_ns: int
    sharpness: float
    motion: float = 0.0
    segment: int = 0
    followed: bool = False


@dataclass(frozen=True)
class _Small:
    """A frame's small picture and its row."""

    image: U8
    row: _Row


class Motion:
    """Takes an input's frames one by one; keeps two small pictures, and the last few after a cut.

    `camera` tells the bearings, `settings` what counts as due.
    """

    def __init__(self, camera: Camera, settings: KeyframeSettings) -> None:
        self._camera, self._settings = camera, settings
        self._rows: list[_Row] = []
        self._top, self._base, self._segment = 0.0, 0.0, 0
        self._anchor: _Small | None = None
        self._last: _Small | None = None
        self._pending: list[_Small] = []
        self._usual = 0.0
        self._start = self._guess = _NOTHING
        self._bearings = np.empty((0, 3))

    def add(self, index: int, time_ns: int, image: U8) -> None:
        """The next frame, a grey picture (H, W) of the camera's size."""
        small = shrink(image)
        row = _Row(index, time_ns, sharpness(small), self._top, self._segment)
        self._rows.append(row)
        self._take(_Small(small, row))

    def figures(self) -> Figures:
        """Of all frames; none may be added afterwards."""
        while self._pending:
            self._cut()
        rows = self._rows
        return Figures(
            index=np.array([row.index for row in rows], np.int64),
            time_ns=np.array([row.time_ns for row in rows], np.int64),
            motion=np.array([row.motion for row in rows], np.float64),
            sharpness=np.array([row.sharpness for row in rows], np.float64),
            segment=np.array([row.segment for row in rows], np.int64),
            followed=np.array([row.followed for row in rows], bool),
        )

    def _take(self, frame: _Small) -> None:
        frame.row.motion, frame.row.segment = self._top, self._segment
        if self._anchor is None:
            self._set_anchor(frame)
            return
        blurred = frame.row.sharpness < _BLURRED * self._usual
        came = self._follow(frame, blurred)
        # Too far from the anchor, but perhaps not from the last that was followed.
        if came is None and self._last is not self._anchor and self._set_anchor(self._last):
            came = self._follow(frame, blurred)
        if came is not None:
            self._tie(frame, came, blurred)
        elif len(corners(frame.image)) >= _LEAST_POINTS:  # a blank picture is no other place
            self._pending.append(frame)
            if len(self._pending) > _PATIENCE:
                self._cut()

    def _tie(self, frame: _Small, came: float, blurred: bool) -> None:
        """The frame follows; those between that did not were single bad ones."""
        self._pending.clear()
        row = frame.row
        row.followed = True
        row.motion = self._top = max(self._top, self._base + came)
        self._last = frame
        self._usual = max(row.sharpness, _FADES * self._usual)
        if came >= _HIGH_TIME or (came >= 1 and not blurred):
            self._set_anchor(frame)

    def _cut(self) -> None:
        """What could not be followed begins a new segment, a keyframe further on."""
        frames, self._pending = self._pending, []
        self._anchor = self._last = None
        self._usual = 0.0
        self._segment += 1
        self._top = np.floor(self._top + 0.5) + 1.0
        for frame in frames:
            self._take(frame)

    def _set_anchor(self, frame: _Small | None) -> bool:
        """Whether it became the anchor: in a blank picture there is nothing to follow."""
        found = _NOTHING if frame is None else corners(frame.image)
        if frame is None or len(found) < _LEAST_POINTS:
            return False
        self._anchor = self._last = frame
        self._usual = max(frame.row.sharpness, self._usual)
        self._base = frame.row.motion
        frame.row.followed = True
        self._start = self._guess = found
        self._bearings = self._to_bearings(found, frame.image)
        return True

    def _follow(self, frame: _Small, blurred: bool) -> float | None:
        """How far the frame is from the anchor, in what is due; None where it cannot be told."""
        assert self._anchor is not None
        found, ok = follow(self._anchor.image, frame.image, self._start, self._guess)
        count = int(ok.sum())
        least = max(_LEAST_POINTS, _LEAST_SHARE * len(ok))
        if count < least:
            return None
        turn, left = best_rotation(self._bearings[ok], self._to_bearings(found[ok], frame.image))
        s = self._settings
        if (np.degrees(left) < _COHERENT * s.parallax_deg).sum() < least:
            return None
        shift = np.median(found[ok] - self._start[ok], axis=0)
        self._guess = np.where(ok[:, None], found, self._start + shift).astype(np.float32)
        parallax, turn = np.degrees(parallax_of(left)), np.degrees(turn)
        lost = 0.0 if blurred else 1 - count / len(ok)
        return float(max(parallax / s.parallax_deg, turn / s.turn_deg, lost / s.lost))

    def _to_bearings(self, small_px: F32, image: U8) -> F64:
        """Unit vectors (N, 3) of pixels of a small picture (N, 2)."""
        height, width = image.shape
        scale = np.array([self._camera.width_px / width, self._camera.height_px / height])
        rays = self._camera.rays((small_px + 0.5) * scale - 0.5)
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def shrink(image: U8) -> U8:
    """A grey picture (H, W), at most 320 px wide."""
    height, width = image.shape
    if width <= _WIDTH_PX:
        return image
    size = (_WIDTH_PX, max(1, round(height * _WIDTH_PX / width)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def sharpness(image: U8) -> float:
    """The RMS gradient of a grey picture (H, W) over the deviation of its grey levels.

    Free of brightness and exposure, but not of what is seen: it compares frames of one scene.
    """
    grey = image.astype(np.float32)
    variance = float(grey.var())
    if variance < _LEAST_VARIANCE or min(grey.shape) < 2:
        return 0.0
    x = (grey[:-1, 1:] - grey[:-1, :-1]).ravel()
    y = (grey[1:, :-1] - grey[:-1, :-1]).ravel()
    return float(np.sqrt(float(x @ x + y @ y) / (len(x) * variance)))


def corners(image: U8) -> F32:
    """Corners (N, 2) that can be followed, from all over the picture (Shi, Tomasi, CVPR 1994)."""
    height, width = image.shape
    rows, columns = (
        np.linspace(0, size, count + 1).astype(int).tolist()
        for size, count in zip((height, width), _TILES, strict=True)
    )
    parts = [_NOTHING]
    for top, bottom in pairwise(rows):
        for left, right in pairwise(columns):
            tile = image[top:bottom, left:right]
            found = cv2.goodFeaturesToTrack(tile, _POINTS, _QUALITY, _APART_PX)
            if found is not None:
                corner = np.array([left, top], np.float32)
                parts.append(np.asarray(found.reshape(-1, 2) + corner, np.float32))
    at = np.concatenate(parts)
    grey = image.astype(np.float32)
    patch = (_PATCH_PX, _PATCH_PX)
    variance = cv2.blur(grey * grey, patch) - cv2.blur(grey, patch) ** 2
    column, row = np.round(at).astype(np.intp).T
    return np.asarray(at[variance[row, column] >= _LEAST_CONTRAST**2])


def follow(before: U8, after: U8, start: F32, guess: F32) -> tuple[F32, Bools]:
    """Where a picture's pixels (N, 2) are in another, from a guess, and which were found (N,)."""

    def flow(one: U8, other: U8, points: F32, near: F32, levels: int) -> tuple[F32, Bools]:
        found, status, _ = cv2.calcOpticalFlowPyrLK(
            one,
            other,
            points,
            near.copy(),
            winSize=_WINDOW,
            maxLevel=levels - 1,
            criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, _MOST_STEPS, 0.03),
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        return np.asarray(found, np.float32).reshape(-1, 2), status.ravel() == 1

    found, ok = flow(before, after, start, guess, _LEVELS)
    height, width = after.shape
    with np.errstate(invalid="ignore"):
        ok &= ((found >= 0) & (found <= [width - 1, height - 1])).all(axis=1)
    kept = np.flatnonzero(ok)
    if len(kept):
        # Back from a guess that is off, or it would only confirm what it was given.
        off = start[kept] + np.float32(_RETURN_PX)
        back, returned = flow(after, before, found[kept], off, 1)
        ok[kept] = returned & (np.linalg.norm(back - start[kept], axis=1) <= _RETURN_PX)
    return found, ok


def best_rotation(before: F64, after: F64) -> tuple[float, F64]:
    """The angle of the rotation that takes unit vectors (N, 3) to others, and what it leaves (N,).

    Radians. Weights 1 / (1 + (r / s)²) with s twice the median of what is left make it robust.
    """
    weight = np.ones(len(before))
    for _ in range(_ROUNDS):
        U, _, Vt = np.linalg.svd((weight[:, None] * after).T @ before)
        R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt)) or 1.0]) @ Vt
        left = np.linalg.norm(after - before @ R.T, axis=1)
        weight = 1 / (1 + (left / max(2 * float(np.median(left)), 1e-9)) ** 2)
    turn = np.arccos(np.clip((np.trace(R) - 1) / 2, -1.0, 1.0))
    return float(turn), 2 * np.arcsin(np.clip(left / 2, 0.0, 1.0))


def parallax_of(left: F64) -> float:
    """The parallax between two pictures, of what `best_rotation` leaves of their bearings."""
    return float(np.percentile(left, _PARALLAX_QUANTILE))
