"""The board in a picture: whichever way it is held, as far as it is there, and how sharp."""

from collections.abc import Iterator
from typing import ClassVar

import cv2
import numpy as np
import pytest
from board_views import BoardCamera, Pictured, Waypoints, pose_of

from ground_station.arrays import U8
from ground_station.calibration.board import Board
from ground_station.calibration.detection import (
    BoardFinder,
    BoardObservation,
    Gathered,
    gather,
    other_board,
)
from ground_station.calibration.errors import CalibrationError
from ground_station.calibration.verdict import check_seen
from ground_station.geometry.camera import THESIS_CAMERA, Camera
from ground_station.geometry.resizing import scaled
from ground_station.recording.frames import Frame

CAMERA = scaled(THESIS_CAMERA, 480, 360)
BOARD = Board([8, 6], 30.0, 22.5)
FINDER = BoardFinder(BOARD, BOARD.points_m())


def still(centre: tuple[float, float] = (0.5, 0.5), distance_m: float = 0.32, **how: float):
    """A board that rests; the place is a share of the picture."""
    roll = how.get("roll_deg", 0.0)
    at = centre[0] * CAMERA.width_px, centre[1] * CAMERA.height_px
    pose = pose_of(CAMERA, BOARD, at, distance_m, (how.get("tilt", 20.0), -12.0), roll)
    return Waypoints(np.array([pose, pose]))


def taken(motion: Waypoints, **how: object) -> U8:
    return BoardCamera(CAMERA, BOARD).take(motion, 0.1, rng=np.random.default_rng(1), **how)


def found(image: U8) -> BoardObservation | None:
    return FINDER.find(Frame(0, "picture", 0, image))


def off_px(seen: BoardObservation, motion: Waypoints, camera: Camera = CAMERA) -> np.ndarray:
    """How far each corner is from where it truly is, the readout left out: the board rests."""
    turned = cv2.Rodrigues(motion.poses[0, :3])[0]
    points = FINDER.points_m[seen.ids] @ turned.T + motion.poses[0, 3:]
    return np.linalg.norm(seen.px - camera.project(points), axis=1)


@pytest.mark.parametrize("roll_deg", [0.0, 180.0, -93.0])
def test_however_it_is_turned_every_corner_is_the_right_one(roll_deg: float) -> None:
    motion = still(roll_deg=roll_deg)
    seen = found(taken(motion))
    assert seen is not None
    assert len(seen.ids) == BOARD.corners
    off = off_px(seen, motion)
    assert np.sqrt((off**2).mean()) < 0.15 and off.max() < 0.5


def test_partly_out_of_view_gives_the_corners_in_view() -> None:
    motion = still((0.85, 0.9), 0.3)
    seen = found(taken(motion))
    assert seen is not None
    assert 8 <= len(seen.ids) < BOARD.corners
    assert off_px(seen, motion).max() < 0.5


def test_covered_in_part_and_without_a_margin() -> None:
    """A person's arm before it; cut out at its edge, on a dark floor."""
    motion = still()
    dark = BoardCamera(CAMERA, BOARD, Pictured(around=15.0, margin_squares=0.0))
    image = dark.take(motion, 0.1, rng=np.random.default_rng(2))
    image[:, 150:215] = cv2.GaussianBlur(image[:, 150:215], (0, 0), 9)
    seen = found(image)
    assert seen is not None
    assert 8 <= len(seen.ids) < BOARD.corners
    assert off_px(seen, motion).max() < 1.0


def test_a_wrong_corner_is_thrown_out(monkeypatch: pytest.MonkeyPatch) -> None:
    image = taken(still())
    finder = BoardFinder(BOARD, BOARD.points_m())
    corners, ids, *rest = finder._detector.detectBoard(image)
    corners = corners.copy()
    corners[4, 0] += [20, -15]

    class Wrong:
        def detectBoard(self, _: U8) -> tuple:
            return corners, ids, *rest

    monkeypatch.setattr(finder, "_detector", Wrong())
    seen = finder.find(Frame(0, "picture", 0, image))
    assert seen is not None
    assert ids.ravel()[4] not in seen.ids and len(seen.ids) == len(ids) - 1


def test_edges_are_as_wide_as_they_were_blurred() -> None:
    image = taken(still())
    widths = []
    for sigma in (0.0, 0.7, 1.1):
        blurred = cv2.GaussianBlur(image, (0, 0), sigma) if sigma else image
        seen = found(blurred)
        assert seen is not None
        widths.append(seen.edge_px)
    # A step blurred by a Gaussian rises by its height over √(2π)·sigma: 0.6 px are the lens's own,
    # 0.29 px each pixel's width.
    for width, sigma in zip(widths[1:], (0.7, 1.1), strict=True):
        total = np.sqrt(sigma**2 + 0.6**2 + 1 / 12)
        assert width == pytest.approx(np.sqrt(2 * np.pi) * total, rel=0.3)
    assert widths[0] < widths[1] < widths[2]


def test_blur_along_one_direction_counts() -> None:
    image = taken(still(tilt=0.0))
    smeared = cv2.blur(image, (4, 1))
    sharp, blurred = found(image), found(smeared)
    assert sharp is not None and blurred is not None
    assert blurred.edge_px > sharp.edge_px + 1


class Interrupted:
    """An input whose person has seen enough after two frames."""

    camera = None
    notes: ClassVar[list[str]] = []

    def count(self) -> int:
        return 5

    def __iter__(self) -> Iterator[Frame]:
        image = taken(still())
        for k in range(2):
            yield Frame(k, f"frame-{k}", k, image)
        raise KeyboardInterrupt


def test_ctrl_c_keeps_what_was_seen() -> None:
    seen = gather([Interrupted()], ["live"], FINDER)
    assert seen.interrupted and seen.frames == len(seen.observations) == 2


def refusal(*images: U8, finder: BoardFinder = FINDER) -> str:
    assert all(finder.find(Frame(0, "", 0, image)) is None for image in images)
    gathered = Gathered(len(images), (480, 360), [], list(images))
    with pytest.raises(CalibrationError) as refused:
        check_seen(gathered, finder)
    assert "\n" not in str(refused.value)
    return str(refused.value)


def test_why_there_is_no_board() -> None:
    image = taken(still())
    assert "mirrored" in refusal(np.ascontiguousarray(image[:, ::-1]))
    other = Board([8, 6], 30.0, 22.5, "6X6_50")
    assert "dictionary 4X4" in refusal(image, finder=BoardFinder(other, other.points_m()))
    assert "no frame of 1 shows a board" in refusal(np.full((360, 480), 90, np.uint8))
    far = taken(still((0.97, 0.97), 0.28))
    if FINDER.corners_of(far):
        assert "corners were made out" in refusal(far)
    noise = np.random.default_rng(3).integers(0, 255, (360, 480)).astype(np.uint8)
    assert other_board(BOARD, [noise] * 3) is None
