"""`blimp calibrate`: a board, pictures of it, a camera's file; bad input in one line."""

import argparse
import json
import socket
import sys
import threading
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
from board_flight import write_board_flight
from board_views import BoardCamera, carried

from ground_station.calibration.board import Board, load_board, write_board
from ground_station.calibration.command import _open
from ground_station.calibration.live import LiveFrames, parse_uri
from ground_station.cli import main
from ground_station.errors import InputError
from ground_station.geometry.camera import THESIS_CAMERA, load_camera
from ground_station.geometry.resizing import scaled

sys.path.insert(0, str(Path(__file__).parents[1] / "evaluation"))
sys.path.insert(0, str(Path(__file__).parents[1] / "stream"))
from numbered_flight import capture_ns, encoded, packets, stamped
from parsed_page import Page

CAMERA = scaled(THESIS_CAMERA, 360, 270)
BOARD = Board([9, 6], 28.0, 21.0)


@pytest.fixture(scope="module")
def board_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("board") / "board.toml"
    write_board(path, BOARD)
    return path


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The board carried through the picture: 10 s at 15 Hz, through H.264."""
    rng = np.random.default_rng(21)
    motion = carried(CAMERA, BOARD, rng, 17, rest_s=0.1, move_s=0.5)
    times = np.arange(0.03, motion.duration_s - 0.03, 1 / 15)
    path = tmp_path_factory.mktemp("flight") / "board.mcap"
    return write_board_flight(path, BoardCamera(CAMERA, BOARD), motion, times, 0.004, rng)


def refusal(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    assert main(["calibrate", *map(str, arguments)]) == 2
    said = capsys.readouterr().err
    lines = [line for line in said.splitlines() if not line.startswith("calibrate:")]
    assert len(lines) == 1 and lines[0].startswith("blimp calibrate: "), said
    return lines[0]


def test_a_board_is_printed_with_its_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["calibrate", "board", "--out", str(tmp_path / "board.pdf"), "--paper", "a3"]) == 0
    assert (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF")
    board = load_board(tmp_path / "board.toml")
    assert (board.squares, board.square_mm) == ([10, 7], 37.0)
    assert "100 mm" in capsys.readouterr().out
    out = tmp_path / "b.pdf"
    for wrong in (["--squares", "2x9"], ["--squares", "ten"], ["--square-mm", "nan"],
                  ["--square-mm", "60"], ["--json", str(tmp_path / "x")]):  # fmt: skip
        refusal(capsys, "board", "--out", out, *wrong)
    assert ".pdf" in refusal(capsys, "board", "--out", tmp_path / "board.png")
    (tmp_path / "b.toml").write_text("width_px = 640\n")  # a camera's
    assert "b.toml" in refusal(capsys, "board", "--out", out)
    assert not out.exists()


def test_a_recording_becomes_a_camera(
    tmp_path: Path, flight: Path, board_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, figures, page = tmp_path / "camera.toml", tmp_path / "c.json", tmp_path / "c.html"
    status = main(
        ["calibrate", str(flight), "--board", str(board_file), "--out", str(out),
         "--json", str(figures), "--report", str(page)]
    )  # fmt: skip
    said = capsys.readouterr()
    assert status == 0, said.err
    camera = load_camera(out)
    assert (camera.width_px, camera.height_px) == (360, 270)
    assert camera.fx_px == pytest.approx(CAMERA.fx_px, rel=0.003)
    assert camera.cx_px == pytest.approx(CAMERA.cx_px, abs=1.5)
    assert camera.cy_px == pytest.approx(CAMERA.cy_px, abs=1.5)
    assert camera.readout_s == pytest.approx(CAMERA.readout_s, rel=0.1)
    document = json.loads(figures.read_text())
    assert document["camera"]["fx_px"] == pytest.approx(camera.fx_px, abs=1e-3)
    assert document["readout"]["determined"] is True
    assert {region["name"] for region in document["regions"]} >= {"upper left", "lower right"}
    assert sum(r["corners"] for r in document["regions"]) == document["corners"]["used"]
    assert len(document["views"]) == document["frames"]["used"] >= 10
    assert "±" in out.read_text() and tomllib.loads(out.read_text())["model"] == "opencv5"
    parsed = Page(page.read_text())
    pictures = [attrs["src"] for tag, attrs in parsed.tags if tag == "img"]
    assert len(pictures) == 3 and all(str(p).startswith("data:image/png") for p in pictures)
    assert not any(tag in ("script", "link") for tag, _ in parsed.tags)
    assert "upper left" in parsed.words and "readout_s" in parsed.words
    assert "fx_px" in said.out and "upper right" in said.out


def test_inputs_that_do_not_go_together_are_refused(
    tmp_path: Path, board_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small, large, board = tmp_path / "small", tmp_path / "large", ["--board", board_file]
    for folder, size in ((small, (120, 160)), (large, (240, 320))):
        folder.mkdir()
        for k in range(3):
            cv2.imwrite(str(folder / f"{k}.png"), np.full(size, 80 + k, np.uint8))
    out = tmp_path / "camera.toml"
    text = refusal(capsys, small, large, *board, "--out", out)
    assert "320x240" in text and "160x120" in text
    assert "no frame of 3" in refusal(capsys, small, *board, "--out", out)
    assert "--board" in refusal(capsys, small, "--out", out)
    assert "--paper" in refusal(capsys, small, *board, "--out", out, "--paper", "a4")
    assert "--views" in refusal(capsys, small, *board, "--out", out, "--views", "2")
    assert "folder" in refusal(capsys, small, *board, "--out", tmp_path / "no" / "camera.toml")
    assert "nowhere" in refusal(capsys, tmp_path / "nowhere", *board, "--out", out)
    assert "--seconds" in refusal(capsys, "udp://:5600", *board, "--out", out, "--seconds", "nan")
    assert not out.exists()


def test_too_few_views_are_refused_and_nothing_is_written(
    tmp_path: Path, flight: Path, board_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "camera.toml"
    text = refusal(capsys, flight, "--range", "0:8", "--board", board_file, "--out", out)
    assert "known to" in text or "open" in text
    assert "no corner of the board was seen in" in text
    assert not out.exists()


@pytest.mark.parametrize(
    ("uri", "where"),
    [
        ("udp://:5600", ("127.0.0.1", 5600)),
        ("udp:", ("127.0.0.1", 5600)),
        ("udp://0.0.0.0:6000", ("0.0.0.0", 6000)),
        ("udp://[::1]:5601", ("::1", 5601)),
        ("udp://:0", None),
        ("udp://:70000", None),
        ("udp://host name:1", None),
        ("udp:flight.mcap", None),
    ],
)
def test_where_a_live_stream_comes_in(uri: str, where: tuple[str, int] | None) -> None:
    if where is None:
        with pytest.raises(InputError, match="udp://HOST:PORT"):
            parse_uri(uri)
    else:
        assert parse_uri(uri) == where


@pytest.fixture
def port() -> int:
    """Of UDP, one that nobody listens at."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        return int(taken.getsockname()[1])


@contextmanager
def sending(port: int, datagrams_from: Callable[[int], list[bytes]]) -> Iterator[None]:
    """Sends what is made with a sequence number, again and again: until somebody listens."""
    stop = threading.Event()

    def send() -> None:
        number = 0
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not stop.wait(0.02):
                datagrams = datagrams_from(number)
                number += len(datagrams)
                for datagram in datagrams:
                    sender.sendto(datagram, ("127.0.0.1", port))

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def test_a_live_stream_gives_frames_with_their_capture_times(port: int) -> None:
    datagrams = packets([stamped(unit, k) for k, unit in enumerate(encoded(6))])
    with sending(port, lambda _: datagrams):
        frames = list(islice(LiveFrames(f"udp://127.0.0.1:{port}", 20.0), 3))
    assert all(frame.time_ns in {capture_ns(k) for k in range(6)} for frame in frames)
    assert all(frame.image.shape == (480, 640) for frame in frames)


def test_a_stream_that_cannot_be_shown_says_why(port: int) -> None:
    unit = stamped(encoded(2)[1], 1)  # refers to what came before, and has no parameter sets
    with (
        sending(port, lambda number: packets([unit], first=number)),
        pytest.raises(InputError, match=f":{port}: .*no parameter sets"),
    ):
        list(LiveFrames(f"udp://127.0.0.1:{port}", 60.0))


def test_a_silent_port_is_said(port: int) -> None:
    with pytest.raises(InputError, match=f":{port}: no video came within"):
        list(LiveFrames(f"udp://127.0.0.1:{port}", 0.2))


@pytest.mark.parametrize(
    ("name", "rate_hz", "timed"),
    [("9.500.png", None, True), ("board-9.png", None, False), ("board-9.png", 30.0, True)],
)
def test_images_time_the_shutter_where_their_times_are_known(tmp_path, name, rate_hz, timed):
    cv2.imwrite(str(tmp_path / name), np.zeros((4, 4), np.uint8))
    asked = argparse.Namespace(inputs=[str(tmp_path)], rate_hz=rate_hz, range=None, seconds=None)
    assert _open(asked)[1] == [timed]
