"""The ChArUco board: a chessboard whose white squares hold markers (Garrido-Jurado et al. 2014).

Its corners are told apart by the markers beside them, so that a board partly out of view, turned
around or covered in part still gives corners. Board axes: x along a row of squares, y down the
rows, z into the paper; the origin is the first square's outer corner.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tomli_w

from ground_station.arrays import F64
from ground_station.calibration.errors import CalibrationError
from ground_station.files import write_text
from pi_firmware.wire import config
from pi_firmware.wire.errors import ConfigError

DICTIONARIES = [f"{bits}X{bits}_{size}" for bits in (4, 5, 6, 7) for size in (50, 100, 250, 1000)]
"""OpenCV's predefined dictionaries of markers, without its prefix `DICT_`."""

MARKER_SHARE = 0.75
"""Side of a marker by side of its square, on boards that are printed here."""

_REQUIRED = ("squares", "square_mm", "marker_mm", "dictionary")


@dataclass(frozen=True)
class Board:
    """A board as its file tells; lengths as they were measured on the paper."""

    squares: list[int] = config.key([10, 7], "squares across and down", low=3, high=40)
    square_mm: float = config.key(25.0, "side of a square", unit="mm", low=1, high=1000)
    marker_mm: float = config.key(18.75, "side of a marker", unit="mm", low=0.5, high=1000)
    dictionary: str = config.key("4X4_50", "the markers' dictionary", choices=DICTIONARIES)
    legacy_pattern: bool = config.key(
        False, "made by OpenCV before 4.6, whose boards of even rows begin with a white square"
    )

    def __post_init__(self) -> None:
        if len(self.squares) != 2:
            raise ValueError(f"'squares' holds {len(self.squares)} numbers; two, across and down")
        if not 0.3 <= self.marker_mm / self.square_mm <= 0.95:
            raise ValueError(
                f"'marker_mm' is {self.marker_mm:g}; 0.3 to 0.95 of the square's {self.square_mm:g}"
            )
        markers, size = self.markers, int(self.dictionary.split("_")[1])
        if markers > size:
            raise ValueError(
                f"'dictionary' {self.dictionary} has {size} markers; "
                f"{self.columns}x{self.rows} squares need {markers}"
            )

    @property
    def columns(self) -> int:
        """Squares across."""
        return self.squares[0]

    @property
    def rows(self) -> int:
        """Squares down."""
        return self.squares[1]

    @property
    def markers(self) -> int:
        """How many markers it has: one in each white square."""
        return self.columns * self.rows // 2

    @property
    def corners(self) -> int:
        """How many corners it has: where four squares meet."""
        return (self.columns - 1) * (self.rows - 1)

    @property
    def name(self) -> str:
        """What it is, in a few words."""
        return f"{self.columns}x{self.rows} squares with markers of {self.dictionary}"

    def points_m(self, measured_mm: tuple[float, float] | None = None) -> F64:
        """All corners (N, 3), metres, by id: row by row.

        `measured_mm` are a square's width and height as measured, for a printer that scales.
        """
        x, y = np.meshgrid(np.arange(1, self.columns), np.arange(1, self.rows))
        width, height = measured_mm or (self.square_mm, self.square_mm)
        flat = [x.ravel() * width, y.ravel() * height, np.zeros(x.size)]
        return np.stack(flat, axis=1) / 1000.0

    def charuco(self) -> cv2.aruco.CharucoBoard:
        """The board as OpenCV's, lengths in millimetres."""
        made = cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.square_mm, self.marker_mm, dictionary(self.dictionary)
        )
        made.setLegacyPattern(self.legacy_pattern)
        return made

    def black_mm(self) -> F64:
        """What is to be printed: black rectangles (K, 4), x y width height from the top left."""
        board = self.charuco()
        marks: Any = board.getDictionary()
        side = marks.markerSize + 2  # with the black border
        bit = self.marker_mm / side
        white: set[tuple[int, int]] = set()
        found = []
        ids = np.asarray(board.getIds()).ravel()
        for number, corners in zip(ids, board.getObjPoints(), strict=True):
            left, top = np.asarray(corners, np.float64)[:, :2].min(axis=0)
            white.add((int(left // self.square_mm), int(top // self.square_mm)))
            bits = marks.generateImageMarker(int(number), side)
            for row, line in enumerate(bits):
                # Runs of black bits: where it changes, with white on both ends.
                dark = np.concatenate([[False], line < 128, [False]]).astype(np.int8)
                edges = np.flatnonzero(np.diff(dark))
                for begin, end in edges.reshape(-1, 2):
                    found.append((left + begin * bit, top + row * bit, (end - begin) * bit, bit))
        for row in range(self.rows):
            for column in range(self.columns):
                if (column, row) not in white:
                    s = self.square_mm
                    found.append((column * s, row * s, s, s))
        return np.array(found)


def dictionary(name: str) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary of that name."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))


def new_board(columns: int, rows: int, square_mm: float) -> Board:
    """A board to print; raises `CalibrationError` naming what is out of range."""
    needed = columns * rows // 2
    # The fewest markers that suffice are the easiest to tell apart.
    name = next((n for n in DICTIONARIES[:4] if int(n.split("_")[1]) >= needed), DICTIONARIES[3])
    values = {
        "squares": [columns, rows],
        "square_mm": square_mm,
        "marker_mm": round(square_mm * MARKER_SHARE, 4),
        "dictionary": name,
    }
    return config.from_mapping(values, Board, where="blimp calibrate board")


def load_board(path: str | Path) -> Board:
    """Reads a board's file; raises `ConfigError` or `CalibrationError` with one line."""
    made = "blimp calibrate board --out board.pdf writes a board's file"
    try:
        document = config.read(path)
    except ConfigError as error:
        raise CalibrationError(f"{error}; {made}") from None
    missing = [name for name in _REQUIRED if name not in document]
    if missing:
        raise CalibrationError(f"{path}: the key '{missing[0]}' is missing; {made}")
    return config.from_mapping(document, Board, where=str(path))


def write_board(path: str | Path, board: Board) -> None:
    """Writes the board's file, beside and renamed."""
    lines = [
        "# A ChArUco board, as `blimp calibrate` reads it. Lengths are those on the paper: measure",
        "# them. One scale of both directions does not change the lens, only distances.",
        tomli_w.dumps(asdict(board)),
    ]
    write_text(path, "\n".join(lines))


def parse_measured(text: str) -> tuple[float, float]:
    """`MM` or `WIDTHxHEIGHT` of a square, millimetres; raises `CalibrationError`."""
    parts = text.lower().split("x")
    try:
        values = [float(part) for part in parts]
    except ValueError:
        values = []
    if len(values) not in (1, 2) or not all(math.isfinite(v) and 1 <= v <= 1000 for v in values):
        raise CalibrationError(
            f"--square-mm-measured is {text!r:.40}; a square's side, 1 to 1000 mm, or WIDTHxHEIGHT"
        )
    return values[0], values[-1]
