"""Which frames of a video become the map's images: evenly spaced by motion, and sharp.

Every n-th frame gives hundreds of the same view where the camera hovers, and too few where it
turns. Here a keyframe is due when the camera moved or turned so far, or so much came newly into
view, and the sharpest frame near that moment is taken.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ground_station.arrays import F64, I64, Bools
from ground_station.geometry.camera import Camera
from ground_station.mapping.construction.images import check_size
from ground_station.mapping.construction.motion import Figures, Motion
from ground_station.mapping.settings import KeyframeSettings
from ground_station.recording.frames import Frame

_NEAR = 0.25
"""A frame is near a due moment within this share of the way to the next."""
_CLEAR = 0.9
"""As sharp as this share of those around it, a frame is worth being further from the moment."""
_AROUND_S = 0.5
_AROUND_FRAMES = 2
_SHARP_QUANTILE = 75.0
"""Of the frames around: half of them may be blurred, and the others still tell what sharp is."""
_BRIDGED = 3.0
"""Sharp keyframes no further apart than this still link without a blurred one between them."""
_HALVINGS = 24


@dataclass(frozen=True)
class Choice:
    """The chosen frames of each input, as their indices in it (K,), increasing.

    `due` is how many there would be without a limit, `spacing` how far apart they are, 1 where the
    limit did not matter; `blurred` of them are blurred, because nothing sharper shows what they do.
    """

    index: list[I64]
    due: int
    spacing: float
    blurred: int

    def __len__(self) -> int:
        return sum(len(index) for index in self.index)


def measure(frames: Iterable[Frame], camera: Camera, settings: KeyframeSettings) -> Figures:
    """Figures of an input's frames, read once; `MapError` for a size that is not the camera's."""
    motion = Motion(camera, settings)
    for frame in frames:
        check_size(frame, camera)
        motion.add(frame.index, frame.time_ns, frame.image)
    return motion.figures()


def choose(figures: Sequence[Figures], most: int, settings: KeyframeSettings) -> Choice:
    """At most `most` keyframes of all inputs, each input judged by itself.

    A frame much less sharp than those around it (`min_sharpness`) is taken only where no other
    shows its stretch and the sharp ones either side are too far apart to link. Where more are due
    than `most`, all stand further apart by the same factor: thinned by motion, not by time. Every
    cut begins a keyframe, and so does every photograph that shows nothing of the one before.
    """
    sharp = [relative_sharpness(f) for f in figures]

    def at(spacing: float) -> Choice:
        parts = [
            _spaced(f, s, spacing, settings.min_sharpness)
            for f, s in zip(figures, sharp, strict=True)
        ]
        index = [f.index[rows] for f, (rows, _) in zip(figures, parts, strict=True)]
        return Choice(index, 0, spacing, sum(blurred for _, blurred in parts))

    wanted = at(1.0)
    due = len(wanted)
    if due > most:
        near, far = 1.0, 2.0 * max(float(f.motion[-1]) for f in figures if len(f)) + 2.0
        wanted = at(far)
        for _ in range(_HALVINGS):
            middle = (near + far) / 2
            tried = at(middle)
            if len(tried) > most:
                near = middle
            else:
                far, wanted = middle, tried
    return Choice(wanted.index, due, wanted.spacing, wanted.blurred)


def relative_sharpness(figures: Figures) -> F64:
    """Each frame's sharpness over that of the sharper ones around it (N,), 0 if not followed.

    Around: half a second either way, at least two frames, without a cut between. What a camera
    looks at changes the measure more than blur does, so frames further off do not compare.
    """
    time_s, value = figures.time_ns / 1e9, figures.sharpness
    result = np.zeros(len(figures))
    for segment in np.unique(figures.segment):
        rows = np.flatnonzero(figures.segment == segment)
        t = np.maximum.accumulate(time_s[rows])
        order = np.arange(len(rows))
        first = np.minimum(np.searchsorted(t, t - _AROUND_S), np.maximum(order - _AROUND_FRAMES, 0))
        last = np.maximum(
            np.searchsorted(t, t + _AROUND_S, side="right"), order + _AROUND_FRAMES + 1
        )
        for k, row in enumerate(rows):
            usual = np.percentile(value[rows[first[k] : last[k]]], _SHARP_QUANTILE)
            result[row] = value[row] / usual if usual > 0 else 1.0
    result[~figures.followed] = 0.0
    return result


def _spaced(figures: Figures, sharp: F64, spacing: float, min_sharpness: float) -> tuple[I64, int]:
    """One frame a stretch of `spacing`, as rows (K,); how many of them are blurred."""
    if not len(figures):
        return np.empty(0, np.int64), 0
    # Near each other they show the same scene, whose sharpness compares without its neighbours'.
    rank = np.where(figures.followed, figures.sharpness, 0.0)
    # The stretch of moment m, m · spacing, is what is nearer to it than to another.
    stretch = np.floor(figures.motion / spacing + 0.5).astype(np.int64)
    starts = np.flatnonzero(np.diff(stretch, prepend=stretch[0] - 1))
    chosen, good = [], []
    for rows in np.split(np.arange(len(stretch)), starts[1:]):
        off = np.abs(figures.motion[rows] / spacing - stretch[rows[0]])
        near = rows[off <= max(_NEAR, float(off.min()))]
        best = near[np.argmax(rank[near])]
        if sharp[best] < _CLEAR:
            clear = sharp[rows] >= _CLEAR
            if clear.any():
                best = rows[clear][np.argmin(off[clear])]
            else:
                best = rows[np.argmax(rank[rows])]
        chosen.append(int(best))
        good.append(bool(sharp[best] >= min_sharpness))
    keep = _needed(figures, np.array(chosen), np.array(good))
    rows = np.array(chosen, np.int64)[keep]
    return rows, int((~np.array(good)[keep]).sum())


def _needed(figures: Figures, rows: I64, good: Bools) -> Bools:
    """Which of the chosen rows (K,) stay: the sharp ones, and of the others those that link."""
    if not good.any():
        return np.ones(len(rows), dtype=bool)  # a whole input without a sharp frame
    keep = good.copy()
    motion, segment = figures.motion[rows], figures.segment[rows]
    sharp = np.flatnonzero(good)
    for k in np.flatnonzero(~good):
        if not figures.followed[rows[k]]:
            continue  # tied to nothing, it links nothing
        place = int(np.searchsorted(sharp, k))
        before = sharp[place - 1] if place else None
        after = sharp[place] if place < len(sharp) else None
        if before is None or after is None:
            continue  # at an end it links nothing
        same = segment[before] == segment[k] == segment[after]
        keep[k] = same and motion[after] - motion[before] > _BRIDGED
    return keep
