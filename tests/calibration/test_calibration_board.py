"""The board: printed at true size, described by its file, refused when it cannot be."""

import re
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from ground_station.calibration import paper
from ground_station.calibration.board import (
    Board,
    load_board,
    new_board,
    parse_measured,
    write_board,
)
from ground_station.calibration.errors import CalibrationError
from pi_firmware.wire.errors import BlimpError, ConfigError

POINT_MM = 25.4 / 72


def drawing_of(pdf: bytes) -> str:
    """The operators of a PDF's page."""
    streams = re.findall(rb"stream\r?\n(.*?)endstream", pdf, re.DOTALL)
    texts = []
    for stream in streams:
        try:
            texts.append(zlib.decompress(stream).decode("latin-1"))
        except zlib.error:
            continue
    return next(text for text in texts if " re\n" in text or " l\n" in text)


@pytest.mark.parametrize(("size", "columns", "rows"), [("a4", 10, 7), ("a3", 6, 9)])
def test_the_pdf_has_the_papers_size_and_the_boards(
    tmp_path: Path, size: str, columns: int, rows: int
) -> None:
    side = paper.largest_square_mm(size, columns, rows)
    board = new_board(columns, rows, side)
    paper.write_pdf(tmp_path / "board.pdf", board, size)
    pdf = (tmp_path / "board.pdf").read_bytes()
    box = re.search(rb"/MediaBox \[ ?0 0 ([\d.]+) ([\d.]+)", pdf)
    assert box is not None
    width, height = sorted(paper.PAPERS_MM[size], reverse=columns >= rows)
    assert float(box[1]) * POINT_MM == pytest.approx(width, abs=0.01)
    assert float(box[2]) * POINT_MM == pytest.approx(height, abs=0.01)
    number = r"(-?[\d.]+)"
    moves = [
        tuple(float(v) * POINT_MM for v in match)
        for match in re.findall(rf"{number} {number} [ml]\n", drawing_of(pdf))
    ]
    drawn = np.array(moves)
    inside = (drawn > 1).all(axis=1) & (drawn < [width - 1, height - 1]).all(axis=1)
    drawn = drawn[inside]  # without the white of the page
    lengths = np.abs(np.diff(drawn, axis=0))
    ruler = np.flatnonzero((np.abs(lengths[:, 0] - paper.RULER_MM) < 0.01) & (lengths[:, 1] < 1e-6))
    assert len(ruler) >= 1
    black = drawn[: ruler[-1]]
    black = black[black[:, 1] > 24.0]  # above the foot
    extent = np.ptp(black, axis=0)
    # With a black square in the first corner, and in another, the board's own size is drawn.
    assert extent[0] == pytest.approx(columns * side, abs=0.01)
    assert extent[1] == pytest.approx(rows * side, abs=0.01)


@pytest.mark.parametrize("legacy", [False, True])
def test_what_is_drawn_is_what_is_looked_for(tmp_path: Path, legacy: bool) -> None:
    """The page as a picture: OpenCV finds every corner where the drawing has put it."""
    board = Board([8, 6], 24.0, 18.0, "5X5_50", legacy)
    figure = paper.draw(board, "a4")
    dpi = 127.0  # 5 px a millimetre
    figure.savefig(tmp_path / "page.png", dpi=dpi)
    page = cv2.imread(str(tmp_path / "page.png"), cv2.IMREAD_GRAYSCALE)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board.charuco()).detectBoard(page)
    assert sorted(ids.ravel()) == list(range(board.corners))
    room = paper.room_mm("a4", 8, 6)
    left = 8 + (room[0] - 8 * 24) / 2
    top = 8 + (room[1] - 6 * 24) / 2
    drawn = (board.points_m()[ids.ravel(), :2] * 1000 + [left, top]) * dpi / 25.4 - 0.5
    assert np.abs(corners.reshape(-1, 2) - drawn).max() < 0.6


def test_its_file_says_the_same(tmp_path: Path) -> None:
    board = new_board(9, 14, 17.5)
    assert board.dictionary == "4X4_100"  # 63 markers
    write_board(tmp_path / "board.toml", board)
    assert load_board(tmp_path / "board.toml") == board


def test_a_measured_square_scales_both_ways_on_its_own() -> None:
    points = Board().points_m(parse_measured("25.2x24.9"))
    assert points[-1] == pytest.approx([9 * 0.0252, 6 * 0.0249, 0])
    for text in ("0", "nan", "25x25x25", "x", "-25", "25mm"):
        with pytest.raises(CalibrationError, match="square-mm-measured"):
            parse_measured(text)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ("square_mm = nan", "square_mm"),
        ("square_mm = 0.5", "square_mm"),
        ("marker_mm = 25.0", "marker_mm"),
        ("squares = [10]", "squares"),
        ("squares = [10, 2]", "squares"),
        ("squares = [20, 20]", "400|200"),
        ('dictionary = "9X9_50"', "dictionary"),
        ("colour = 1", "colour"),
    ],
)
def test_a_file_that_cannot_be_is_refused_by_name(tmp_path: Path, change: str, named: str) -> None:
    write_board(tmp_path / "board.toml", Board())
    lines = (tmp_path / "board.toml").read_text()
    key = change.split(" =")[0]
    lines = re.sub(rf"^{key} = (\[.*?\]|[^\n]*)\n", "", lines, flags=re.DOTALL | re.MULTILINE)
    (tmp_path / "board.toml").write_text(lines + change + "\n")
    with pytest.raises(ConfigError, match=named) as refused:
        load_board(tmp_path / "board.toml")
    assert "\n" not in str(refused.value)


def test_a_file_without_a_size_is_no_board(tmp_path: Path) -> None:
    (tmp_path / "board.toml").write_text("squares = [10, 7]\n")
    with pytest.raises(BlimpError, match="square_mm"):
        load_board(tmp_path / "board.toml")


def test_a_board_larger_than_its_paper_is_refused() -> None:
    with pytest.raises(CalibrationError, match=r"a4 has room for .* \(squares of \d+ mm\)"):
        paper.draw(new_board(10, 7, 40.0), "a4")
