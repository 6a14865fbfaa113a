"""The board in one picture: its corners, how sharp they are, and why it is not seen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from ground_station.arrays import F64, I64, U8, Bools
from ground_station.calibration.board import DICTIONARIES, Board, dictionary
from ground_station.errors import InputError
from ground_station.progress import Progress
from ground_station.recording.frames import Frame, FrameSource

MIN_CORNERS = 8
"""A homography needs four corners; twice as many tell when one of them is wrong."""
_OFF_SQUARES = 0.3
"""A corner further from where the others' homography puts it is another one; lenses bend less."""
_REACH = 0.1
"""How far beside an edge is looked, in squares: at 0.125 the marker begins."""
_STEP_PX = 0.5


@dataclass(frozen=True)
class BoardObservation:
    """The board in frame `index` of the `source`-th input.

    `ids` (N,) and pixels `px` (N, 2) of its corners, `square_px` the side of a square there,
    `edge_px` how wide a step from black to white is: 1 where nothing is blurred, and 2.5 deviations
    of a Gaussian blur. `H` (3, 3) takes board metres to pixels, without a lens.
    """

    source: int
    index: int
    name: str
    time_ns: int
    ids: I64
    px: F64
    square_px: float
    edge_px: float
    H: F64


def apply_homography(H: F64, points: F64) -> F64:
    """Points (N, 2) through a homography (3, 3)."""
    homogeneous = points @ H[:, :2].T + H[:, 2]
    return np.asarray(homogeneous[:, :2] / homogeneous[:, 2:])


class BoardFinder:
    """Finds one board in grey pictures. `points_m` (N, 3) are its corners' true places."""

    def __init__(self, board: Board, points_m: F64) -> None:
        self.board, self.points_m = board, points_m
        self._detector = cv2.aruco.CharucoDetector(board.charuco())
        grid = np.arange(board.corners).reshape(board.rows - 1, board.columns - 1)
        across = np.stack([grid[:, :-1].ravel(), grid[:, 1:].ravel()], 1)
        down = np.stack([grid[:-1].ravel(), grid[1:].ravel()], 1)
        self._pairs = np.concatenate([across, down])
        self._is_across = np.arange(len(self._pairs)) < len(across)

    def find(self, frame: Frame, source: int = 0) -> BoardObservation | None:
        """The board in a frame; None when too few of its corners are there, or on one line."""
        corners, numbers, _, _ = self._detector.detectBoard(frame.image)
        if numbers is None or len(numbers) < MIN_CORNERS:
            return None
        ids = np.asarray(numbers, np.int64).ravel()
        px = np.asarray(corners, np.float64).reshape(-1, 2)
        # An id may come twice; the same corner of two boards is neither.
        _, first, count = np.unique(ids, return_index=True, return_counts=True)
        keep = first[count == 1]
        keep = keep[np.isfinite(px[keep]).all(axis=1)]
        ids, px = ids[keep], px[keep]
        square_px = self._square_px(ids, px)
        if square_px is None:
            return None
        H, inlier = self._homography(ids, px, _OFF_SQUARES * square_px)
        ids, px = ids[inlier], px[inlier]
        if H is None or len(ids) < MIN_CORNERS or self._on_a_line(ids):
            return None
        edge_px = self._edge_px(frame.image, ids, px)
        if edge_px is None:
            return None
        return BoardObservation(
            source, frame.index, frame.name, frame.time_ns, ids, px, square_px, edge_px, H
        )

    def corners_of(self, image: U8) -> int:
        """How many corners there are, however few."""
        numbers = self._detector.detectBoard(image)[1]
        return 0 if numbers is None else len(numbers)

    def _on_a_line(self, ids: I64) -> bool:
        across = self.board.columns - 1
        return min(len(np.unique(ids // across)), len(np.unique(ids % across))) < 2

    def _homography(self, ids: I64, px: F64, off_px: float) -> tuple[Any, Any]:
        if len(ids) < MIN_CORNERS:
            return None, np.zeros(len(ids), bool)
        H, mask = cv2.findHomography(self.points_m[ids, :2], px, cv2.RANSAC, off_px)
        if H is None or not np.isfinite(H).all():
            return None, np.zeros(len(ids), bool)
        return H, mask.ravel().astype(bool)

    def _neighbours(self, ids: I64) -> tuple[I64, Bools]:
        """Places (P, 2) in `ids` of corners that are neighbours; whether each pair is of a row."""
        place = np.full(self.board.corners, -1)
        place[ids] = np.arange(len(ids))
        pairs = place[self._pairs]
        both = (pairs >= 0).all(axis=1)
        return pairs[both], self._is_across[both]

    def _square_px(self, ids: I64, px: F64) -> float | None:
        pairs, _ = self._neighbours(ids)
        if not len(pairs):
            return None
        return float(np.median(np.linalg.norm(px[pairs[:, 0]] - px[pairs[:, 1]], axis=1)))

    def _edge_px(self, image: U8, ids: I64, px: F64) -> float | None:
        """The median width of the edges between squares, of the blurrier direction of the two.

        Each edge between neighbouring corners is crossed three times: the contrast of the board
        over the steepest rise is its width.
        """
        pairs, is_across = self._neighbours(ids)
        a, b = px[pairs[:, 0]], px[pairs[:, 1]]
        along = b - a
        length = np.linalg.norm(along, axis=1, keepdims=True)
        normal = np.stack([-along[:, 1], along[:, 0]], 1) / np.maximum(length, 1e-9)
        reach = max(2.0, _REACH * float(np.median(length)))
        steps = np.arange(-reach, reach + _STEP_PX / 2, _STEP_PX)
        middles = a[:, None] + along[:, None] * np.array([0.35, 0.5, 0.65])[:, None]
        places = middles[:, :, None] + normal[:, None, None] * steps[:, None]
        places = places.reshape(-1, len(steps), 2).astype(np.float32)
        crossed = cv2.remap(image, places[..., 0], places[..., 1], cv2.INTER_LINEAR)
        profiles = np.asarray(crossed, np.float64)
        low, high = np.percentile(profiles, [10, 90])
        two = round(1 / _STEP_PX)
        steepest = np.abs(profiles[:, two:] - profiles[:, :-two]).max(axis=1)
        if high - low < 8 or not len(steepest):  # of 255: nothing that could be sharp
            return None
        width = (high - low) / np.maximum(steepest, 1e-3)
        of_row = np.repeat(is_across, 3)
        groups = [width[of_row], width[~of_row]]
        return max(float(np.median(group)) for group in groups if len(group))


def other_board(board: Board, pictures: list[U8]) -> str | None:
    """What there is instead of the board in pictures without it: a sentence, or None."""
    finder = BoardFinder(board, board.points_m())
    for image in pictures:
        if finder.corners_of(np.ascontiguousarray(image[:, ::-1])) >= MIN_CORNERS:
            return (
                "the pictures are mirrored: switch off the mirror of the camera's program, for "
                "a mirrored lens is another"
            )
    best, most = "", 0
    for name in DICTIONARIES[2::4]:  # of each size: it holds the smaller ones
        detector = cv2.aruco.ArucoDetector(dictionary(name))
        found = 0
        for image in pictures:
            numbers = detector.detectMarkers(image)[1]
            found += 0 if numbers is None else len(np.unique(numbers))
        if found > most:
            best, most = name, found
    own = board.dictionary.split("_")[0]
    if most >= max(4, len(pictures)) and not best.startswith(own):
        return (
            f"the markers in the pictures are of a dictionary {best.split('_')[0]}, those of the "
            f"board's file of {board.dictionary}: another board's file is needed"
        )
    return None


_PICTURES = 12


@dataclass
class Gathered:
    """What was seen: frames looked at, their size, observations by input and time.

    `without` are a few pictures in which the board was not found, more widely apart the longer it
    lasted.
    """

    frames: int = 0
    size_px: tuple[int, int] = (0, 0)
    observations: list[BoardObservation] = field(default_factory=list)
    without: list[U8] = field(default_factory=list)
    interrupted: bool = False


def gather(
    sources: Sequence[FrameSource],
    names: Sequence[str],
    finder: BoardFinder,
    on_frame: Callable[[Gathered], None] | None = None,
) -> Gathered:
    """Looks for the board in all frames; Ctrl-C ends the looking and keeps what was seen.

    `names` are the inputs', for errors. Raises `InputError` where frames differ in size.
    """
    result = Gathered()
    counts = [source.count() for source in sources]
    known = [count for count in counts if count is not None]
    total = sum(known) if len(known) == len(counts) else None
    missing = 0
    with Progress("calibrate", total) as progress:
        try:
            for number, (source, name) in enumerate(zip(sources, names, strict=True)):
                for frame in source:
                    height, width = frame.image.shape
                    if result.frames == 0:
                        result.size_px = (width, height)
                    elif result.size_px != (width, height):
                        raise InputError(
                            f"{name}: {frame.name} has {width}x{height} px, the frames before it "
                            f"{result.size_px[0]}x{result.size_px[1]} px: a camera is calibrated "
                            "at one size"
                        )
                    result.frames += 1
                    seen = finder.find(frame, number)
                    if seen is not None:
                        result.observations.append(seen)
                    else:
                        missing += 1
                        if missing & (missing - 1) == 0 and len(result.without) < _PICTURES:
                            result.without.append(frame.image)
                    if on_frame is not None:
                        on_frame(result)
                    progress.step()
        except KeyboardInterrupt:
            result.interrupted = True
    return result
