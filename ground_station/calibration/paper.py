"""The board on paper: a PDF at true size, with a ruler that tells what the printer made of it."""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline

from ground_station.calibration.board import Board
from ground_station.calibration.errors import CalibrationError
from ground_station.files import write_bytes

PAPERS_MM = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "letter": (215.9, 279.4)}
"""Width and height, upright; ISO 216 and ANSI A."""

RULER_MM = 100.0
_MARGIN_MM = 8.0
"""White around the board: most printers leave 4 to 6 mm empty, and markers want a light border."""
_FOOT_MM = 24.0
"""Below the board: ruler and text."""
_MM_PER_INCH = 25.4


def room_mm(paper: str, columns: int, rows: int) -> tuple[float, float]:
    """Width and height that a board may have; paper lies as the board does."""
    short, long = PAPERS_MM[paper]
    width, height = (long, short) if columns >= rows else (short, long)
    return width - 2 * _MARGIN_MM, height - _MARGIN_MM - _FOOT_MM


def largest_square_mm(paper: str, columns: int, rows: int) -> float:
    """The largest whole millimetres, or below 5 tenths of them, that a square may have."""
    width, height = room_mm(paper, columns, rows)
    side = min(width / columns, height / rows)
    return float(math.floor(side)) if side >= 5 else math.floor(side * 10) / 10


def draw(board: Board, paper: str) -> Figure:
    """The page as a figure of the paper's size; raises `CalibrationError` when it does not fit."""
    wide, high = board.columns * board.square_mm, board.rows * board.square_mm
    room = room_mm(paper, board.columns, board.rows)
    if wide > room[0] + 1e-9 or high > room[1] + 1e-9:
        most = largest_square_mm(paper, board.columns, board.rows)
        raise CalibrationError(
            f"a board of {board.columns}x{board.rows} squares of {board.square_mm:g} mm is "
            f"{wide:g}x{high:g} mm; {paper} has room for {room[0]:g}x{room[1]:g} mm "
            f"(squares of {most:g} mm)"
        )
    page = room[0] + 2 * _MARGIN_MM, room[1] + _MARGIN_MM + _FOOT_MM
    figure = Figure(figsize=(page[0] / _MM_PER_INCH, page[1] / _MM_PER_INCH), facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_xlim(0, page[0])
    axes.set_ylim(page[1], 0)
    axes.axis("off")
    left, top = (page[0] - wide) / 2, _MARGIN_MM + (room[1] - high) / 2
    axes.add_patch(
        PathPatch(_outline(board, left, top), facecolor="black", linewidth=0, snap=False)
    )
    foot = page[1] - _FOOT_MM
    axes.add_patch(
        PathPatch(_ruler(_MARGIN_MM, foot + 9), fill=False, edgecolor="black", linewidth=0.6)
    )
    style: Any = {"fontsize": 7.5, "family": "DejaVu Sans", "va": "center", "color": "black"}
    text = [
        (_MARGIN_MM, foot + 13, f"This line is {RULER_MM:g} mm long when it is printed at 100 %."),
        (
            _MARGIN_MM,
            foot + 17,
            f"{board.columns} squares across: {wide:g} mm; {board.rows} down: {high:g} mm. "
            "If yours differ, give a square's measured size: --square-mm-measured WIDTHxHEIGHT.",
        ),
        (
            _MARGIN_MM + RULER_MM + 6,
            foot + 7.5,
            f"ChArUco {board.columns}x{board.rows}, squares {board.square_mm:g} mm, "
            f"markers {board.marker_mm:g} mm, {board.dictionary}. Glue it onto something flat.",
        ),
    ]
    for x, y, words in text:
        axes.text(x, y, words, **style)
    return figure


def write_pdf(path: str | Path, board: Board, paper: str) -> None:
    """Writes the page, vectors only, beside and renamed."""
    buffer = io.BytesIO()
    draw(board, paper).savefig(
        buffer,
        format="pdf",
        metadata={"Title": f"ChArUco board, {board.name}", "CreationDate": None},
    )
    write_bytes(path, buffer.getvalue())


def _outline(board: Board, left: float, top: float) -> Outline:
    """All that is black as one path: no seams between rectangles that touch."""
    x, y, width, height = board.black_mm().T
    corners = np.array([[x, y], [x + width, y], [x + width, y + height], [x, y + height]])
    return Outline.make_compound_path_from_polys(corners.transpose(2, 0, 1) + np.array([left, top]))


def _ruler(left: float, y: float) -> Outline:
    """A line with a tick every 10 mm."""
    vertices, codes = [(left, y), (left + RULER_MM, y)], [Outline.MOVETO, Outline.LINETO]
    for k in range(11):
        long = 3.0 if k % 5 == 0 else 1.8
        vertices += [(left + k * RULER_MM / 10, y), (left + k * RULER_MM / 10, y - long)]
        codes += [Outline.MOVETO, Outline.LINETO]
    return Outline(vertices, codes)
