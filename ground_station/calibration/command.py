"""`blimp calibrate`: prints a board, and calibrates a camera from views of it."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ground_station.calibration.errors import CalibrationError
from ground_station.errors import check_options
from ground_station.files import check_outputs

if TYPE_CHECKING:
    from ground_station.calibration.board import Board
    from ground_station.calibration.detection import Gathered
    from ground_station.recording.frames import FrameSource

_EPILOG = """\
examples:
  blimp calibrate board --out board.pdf --paper a4
  blimp calibrate board.mcap --board board.toml --out camera.toml --report out/calibration.html
  blimp calibrate udp://:5600 --board board.toml --out camera.toml --seconds 60

The first prints a board and writes its file beside it (board.toml). Glue it onto something flat,
and hold it before the camera: near and far, tilted to all sides, into all corners of the picture,
still now and then. INPUT is a recording, a video, a folder of images, or a live stream. Where the
board moves, the rolling shutter's readout time is measured, too. What the views do not determine
is refused, with what is missing. (A folder called board: ./board.)"""

_OF_BOARD = ("paper", "squares", "square_mm")
_OF_VIEWS = (
    "board", "model", "square_mm_measured", "range", "rate_hz", "seconds", "views", "json",
    "report",
)  # fmt: skip
_HINTS_S = 5.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments; imports nothing heavy."""
    parser.description = "Prints a ChArUco board, and calibrates a camera from views of it."
    parser.epilog = _EPILOG
    parser.set_defaults(next="blimp map build FLIGHT.mcap --camera {out} --out maps/NAME")
    parser.add_argument(
        "inputs", nargs="+", metavar="INPUT",
        help="'board' to print one; or recordings, videos, folders, udp://HOST:PORT",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, required=True, metavar="FILE",
                        help="the board's PDF, or the camera's file")  # fmt: skip
    printing = parser.add_argument_group("to print a board")
    printing.add_argument("--paper", choices=("a4", "a3", "letter"), help="paper (a4)")
    printing.add_argument("--squares", metavar="CxR", help="squares across and down (10x7)")
    printing.add_argument("--square-mm", type=float, metavar="MM",
                          help="side of a square (as large as fits)")  # fmt: skip
    views = parser.add_argument_group("to calibrate")
    views.add_argument("--board", type=Path, metavar="BOARD.toml", help="the board's file")
    views.add_argument(
        "--model", choices=("opencv5", "fisheye"),
        help="of the lens: five parameters (default), or a fisheye's, for more than about 110°",
    )  # fmt: skip
    views.add_argument(
        "--square-mm-measured", metavar="MM", help="a square's side on the paper, or WIDTHxHEIGHT"
    )
    views.add_argument("--range", metavar="A:B[:S]", help="frames A to B-1, every S-th")
    views.add_argument(
        "--rate-hz", type=float, metavar="R",
        help="of what has no times (30); given, a folder counts as a video and times the shutter",
    )  # fmt: skip
    views.add_argument("--seconds", type=float, metavar="S", help="of a live stream (60)")
    views.add_argument("--views", type=int, metavar="N", help="at most so many views (40)")
    views.add_argument("--json", type=Path, metavar="F", help="write the figures to this file")
    views.add_argument("--report", type=Path, metavar="F.html", help="write a page with pictures")


def run(args: argparse.Namespace) -> int:
    """Prints or calibrates; raises a `BlimpError` with one line for what a person can fix."""

    printing = args.inputs == ["board"]
    for name in _OF_VIEWS if printing else _OF_BOARD:
        if getattr(args, name) is not None:
            flag = "--" + name.replace("_", "-")
            where = "is for calibrating" if printing else "is for 'blimp calibrate board'"
            raise CalibrationError(f"{flag} {where}")
    check_outputs(args.out, args.json, args.report)
    return _print(args) if printing else _calibrate(args)


def _print(args: argparse.Namespace) -> int:
    from ground_station.calibration import paper
    from ground_station.calibration.board import new_board, write_board

    if args.out.suffix.lower() != ".pdf":
        raise CalibrationError(f"{args.out}: a board is written as .pdf")
    columns, rows = _squares(args.squares or "10x7")
    size = args.paper or "a4"
    square_mm = args.square_mm
    if square_mm is None:
        square_mm = paper.largest_square_mm(size, columns, rows)
    board = new_board(columns, rows, square_mm)
    description = args.out.with_suffix(".toml")
    if description.exists():
        _check_is_a_board(description)
    paper.write_pdf(args.out, board, size)
    write_board(description, board)
    print(
        f"{board.name}, {board.square_mm:g} mm -> {args.out}, {description}\n"
        f"Print {args.out.name} on {size} at 100 %, and measure the line of "
        f"{paper.RULER_MM:g} mm on it."
    )
    board_file = shlex.quote(str(description))
    args.next = (
        f"blimp calibrate RECORDING.mcap --board {board_file} --out camera.toml"
        "    (a recording of the board before the camera)"
    )
    return 0


def _check_is_a_board(path: Path) -> None:
    """Refuses to write a board's file over another program's."""
    from ground_station.calibration.board import load_board
    from pi_firmware.wire.errors import BlimpError

    try:
        load_board(path)
    except BlimpError:
        raise CalibrationError(
            f"{path}: is there and no board's file; give --out another name"
        ) from None


def _squares(text: str) -> tuple[int, int]:
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(p.isascii() and p.isdigit() and 3 <= int(p) <= 40 for p in parts):
        raise CalibrationError(f"--squares is {text!r:.40}; expected CxR, each 3 to 40, as 10x7")
    return int(parts[0]), int(parts[1])


def _calibrate(args: argparse.Namespace) -> int:
    from ground_station.calibration import results
    from ground_station.calibration.board import load_board, parse_measured
    from ground_station.calibration.calibrate import MAX_VIEWS, calibrate
    from ground_station.calibration.detection import BoardFinder, gather
    from ground_station.files import write_json

    if args.board is None:
        raise CalibrationError("--board BOARD.toml is needed: what 'blimp calibrate board' wrote")
    check_options(args, views=(3, 200), seconds=(1, 3600))
    most = MAX_VIEWS if args.views is None else args.views
    board = load_board(args.board)
    measured = parse_measured(args.square_mm_measured) if args.square_mm_measured else None
    finder = BoardFinder(board, board.points_m(measured))
    sources, timed = _open(args)
    hints = _Hints(board) if any(map(_is_live, args.inputs)) else None
    gathered = gather(sources, args.inputs, finder, hints)
    for source in sources:
        for note in source.notes:
            _log(f"note: {note}")
    if gathered.interrupted:
        _log(f"interrupted: calibrating with the {gathered.frames} frames so far")
    result = calibrate(gathered, finder, timed, most, args.model or "opencv5")
    results.write_camera(args.out, result, board)
    print(results.table(result, gathered.frames))
    for note in result.notes:
        _log(f"note: {note}")
    if args.json:
        write_json(args.json, results.document(result, board, args.inputs, gathered.frames))
    if args.report:
        from ground_station.calibration.page import write_report

        write_report(args.report, result, board, args.inputs, gathered.frames)
    print(f"-> {args.out}")
    return 0


def _is_live(text: str) -> bool:
    return text.startswith("udp:")


def _open(args: argparse.Namespace) -> tuple[list[FrameSource], list[bool]]:
    """The inputs, and of each whether its frames' times are the camera's."""
    from ground_station.calibration.live import LiveFrames
    from ground_station.recording.flight import FlightRecording
    from ground_station.recording.folder import ImageFolder
    from ground_station.recording.open import open_input, parse_range
    from ground_station.recording.video import VideoFile

    wanted = parse_range(args.range) if args.range else None
    seconds = 60.0 if args.seconds is None else args.seconds
    sources: list[Any] = [
        LiveFrames(text, seconds) if _is_live(text) else open_input(text, args.rate_hz, wanted)
        for text in args.inputs
    ]
    own = (FlightRecording, VideoFile, LiveFrames)
    return sources, [
        args.rate_hz is not None
        or isinstance(source, own)
        or (isinstance(source, ImageFolder) and source.timed)
        for source in sources
    ]


class _Hints:
    """Tells a person at a live stream every few seconds what is still missing."""

    def __init__(self, board: Board) -> None:
        import time

        self._clock, self._board = time.monotonic, board
        self._said_s = self._clock()

    def __call__(self, gathered: Gathered) -> None:
        if self._clock() - self._said_s < _HINTS_S:
            return
        self._said_s = self._clock()
        from ground_station.calibration.selection import MAX_EDGE_PX, empty_corners

        sharp = [s for s in gathered.observations if s.edge_px <= MAX_EDGE_PX]
        empty = empty_corners(sharp, gathered.size_px)
        left = f"; not yet: {', '.join(empty)}" if empty else "; all corners: Ctrl-C ends it"
        _log(f"{len(sharp)} sharp views in {gathered.frames} frames{left}")


def _log(text: str) -> None:
    print(f"blimp calibrate: {text}", file=sys.stderr)
