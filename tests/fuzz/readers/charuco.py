"""`ground_station.calibration.board`: files that describe a printed board."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import tomli_w
from pieces import Picker, refusing, scratch, stretch, with_a_line

from ground_station.calibration.board import Board, load_board
from pi_firmware.wire.errors import BlimpError

_FILE = scratch("charuco") / "board.toml"
_WHOLE = b"".join(
    tomli_w.dumps({key: value}, multiline_strings=False).replace("\n", " ").encode() + b"\n"
    for key, value in asdict(Board()).items()
)


def fuzz(data: bytes) -> None:
    """One key of a board's, or all of the file, is the input's."""
    _FILE.write_bytes(with_a_line(Picker(data), _WHOLE))
    with refusing(BlimpError):
        board = load_board(_FILE)
        points = board.points_m()
        assert points.shape == (board.corners, 3) and np.isfinite(points).all()
        assert np.isfinite(board.black_mm()).all()


def seeds() -> list[bytes]:
    """A whole one; numbers that are none; many squares; keys that nest."""
    return [
        b"\xff" + _WHOLE,
        b"\1square_mm = nan",
        b"\1square_mm = 0x" + b"f" * 400,
        b"\0squares = [40, 40]",
        b"\0squares = [40, 40]\nlegacy_pattern = true",
        b"\0squares = 7",
        b"\2marker_mm = -1e308",
        b'\3dictionary = "7X7_1000"',
        stretch((1, b"\xffa = "), (5000, b"[")),
        stretch((1, b"\0squares = [1"), (100_000, b",1"), (1, b"]")),
    ]
