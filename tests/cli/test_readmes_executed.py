"""What the README files say to type is typed, page by page, where each finds what it needs.

What stands in ELSEWHERE is not executed here; it says what does, or what is in the way.
"""

from __future__ import annotations

import itertools
import os
import shutil
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import cases_stand
import numpy as np
import pytest
from board_flight import write_board_flight
from board_views import BoardCamera, carried
from card_bench import make_image, sum_of
from pages import PAGES, ROOT, commands
from quick_flight import quick_light

from ground_station.calibration.board import Board
from ground_station.cli import main as blimp
from ground_station.geometry.camera import THESIS_CAMERA
from ground_station.geometry.resizing import scaled
from ground_station.geometry.trajectory import Trajectory, write_tum
from ground_station.recording.frames import Frame
from ground_station.recording.open import open_input
from ground_station.replay.cases.outcome import write_outcome
from ground_station.simulator import simulate as flights
from ground_station.simulator.lighting import lit_scene
from hw.__main__ import main as hw

ATRIUM = ROOT / "maps/atrium"
CI, OWN = "every change is to pass it, by these words", "minutes to hours: a check of its own"
CARD = "needs a card that was built, and root: `make hil-image` begins with it"
NOT_OURS = "its weights are not ours to ship; tests/feature_models imports made-up ones"
ELSEWHERE = {
    "make check": CI,
    "make test": CI,
    "make demo": CI,
    "make serve": "tests/service/test_whole_service.py: the demo from its start to its end",
    "make image": CARD,
    "make release": "tests/deploy/test_publish.py, and the signature's check",
    "make update": "tests/deploy/update/test_update_flight.py",
    "make hil": OWN,
    "make experiments": OWN,
    "make faults": OWN,
    "make fuzz": OWN,
    "make soak": OWN,
    "make soak-service": OWN,
    "make soak-stream": OWN,
    "make limits": OWN,
    "make sample": OWN,
    "make budget": "tests/hw/test_hw_command.py",
    "make lock": "asks the network for the newest packages",
    "blimp serve --lan": "tests/deploy/flash/test_flash_lan.py: a flashed card reaches it",
    "blimp experiments": "tests/experiments/test_experiments_whole.py, by a file of its own",
    "blimp models import superpoint_v1.pth": NOT_OURS,
    "blimp map build walk.mcap --features superpoint": NOT_OURS,
    "blimp models train": "needs torch, an optional extra: tests/training",
}
SIMULATOR = "ground_station/simulator/README.md"
"""To film a board for long enough takes it minutes: the page of mapping calibrates by another."""
MORE = {
    "blimp simulate": ["--duration-s", "0.5", "--rate-hz", "2"],
    "blimp simulate --scene interior-2 --plan walk": ["--duration-s", "20", "--rate-hz", "1"],
    "blimp map build walk.mcap": ["--range", "0:8"],
    "blimp models quantize": ["--frames", "4"],
    "blimp serve": ["--check"],
    "blimp map register": ["--no-browser"],
    "pi_firmware --config pi_firmware/payload.toml": ["--set", "link.port=9"],
}
"""What is added to words that begin so: less of the same, or without what stays running."""


def begins(words: list[str], these: dict[str, object]) -> str | None:
    """The longest of these that the words begin with."""
    typed = f"{' '.join(words)} "
    return max((one for one in these if typed.startswith(f"{one} ")), key=len, default=None)


def here(page: Path) -> list[list[str]]:
    """The words of a page that are executed here."""
    return [words for words in commands(page) if begins(words, ELSEWHERE) is None]


def write_video(path: Path, frames: list[Frame]) -> None:
    """A phone's file of these pictures, whose times begin at 0."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "16"})
        stream.height, stream.width = frames[0].image.shape
        stream.pix_fmt, stream.codec_context.time_base = "yuv420p", Fraction(1, 1000)
        for frame in frames:
            picture = av.VideoFrame.from_ndarray(np.dstack([frame.image] * 3), format="bgr24")
            picture.pts = (frame.time_ns - frames[0].time_ns) // 1_000_000
            picture.time_base = Fraction(1, 1000)
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))


def building(folder: Path) -> None:
    """A walk, its plan, and another walk whose truth is known: of the sample's mapping flight."""
    frames = list(itertools.islice(open_input(ATRIUM / "mapping.mcap"), 8))
    write_video(folder / "walk.mp4", frames)
    write_video(folder / "other.mp4", frames[2:7])
    (folder / "INPUT").symlink_to("walk.mp4")
    (folder / "OTHER").symlink_to("other.mp4")
    (folder / "walk.mcap").symlink_to(ATRIUM / "mapping.mcap")
    shutil.copy(ATRIUM / "floorplan.png", folder)
    times = [frame.time_ns - frames[2].time_ns for frame in frames[2:7]]
    poses = [cases_stand.true_pose(k) for k in range(len(times))]
    write_tum(folder / "truth.txt", Trajectory.from_poses(times, poses))


def film_of_a_board(folder: Path) -> None:
    """The board that `blimp calibrate board` prints, long enough before the camera."""
    rng = np.random.default_rng(21)
    camera, board = scaled(THESIS_CAMERA, 360, 270), Board([10, 7], 25.0, 18.75)
    motion = carried(camera, board, rng, 17, rest_s=0.1, move_s=0.5)
    times_s = np.arange(0.03, motion.duration_s - 0.03, 1 / 15)
    taker = BoardCamera(camera, board)
    write_board_flight(folder / "board.mcap", taker, motion, times_s, 0.004, rng)


def card(folder: Path) -> None:
    """An image as `make image` leaves it, as small as can be."""
    image = folder / "out/image/blimp-zero2w.img"
    image.parent.mkdir(parents=True)
    make_image(image)
    sum_of(image)
    (folder / "password").write_text("correct horse")
    shutil.copy(image, folder / "card")


def flown(folder: Path) -> None:
    """A recording, its map, and two runs of a case."""
    (folder / "recordings").mkdir()
    (folder / "recordings/main-….mcap").symlink_to(ATRIUM / "flight.mcap")
    (folder / "tests/hil/cases").mkdir(parents=True)
    for run in ("before", "hil"):
        (folder / "out" / run).mkdir(parents=True)
        write_outcome(folder / "out" / run / "hall", cases_stand.outcome())
    mapped(folder)


def mapped(folder: Path) -> None:
    """A map of the hall."""
    (folder / "maps/hall").symlink_to(ATRIUM)


GIVEN: dict[str, list[Callable[[Path], None]]] = {
    "README.md": [building, card],
    "deploy/README.md": [card],
    "ground_station/features/README.md": [building],
    "ground_station/mapping/README.md": [building, film_of_a_board],
    "ground_station/service/README.md": [mapped],
    "tests/hil/README.md": [flown],
}
NAMES = {str(page.relative_to(ROOT)): page for page in PAGES if here(page)}


def test_what_is_executed_elsewhere_is_of_a_page_and_what_is_given_is_needed() -> None:
    named = {begins(words, ELSEWHERE) for page in PAGES for words in commands(page)}
    assert named - {None} == set(ELSEWHERE)
    assert set(GIVEN) <= set(NAMES)


@pytest.mark.parametrize("name", sorted(NAMES))
def test_every_command_of_a_page_is_executed(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(signal, "signal", lambda *_: None)  # the test runner's own stay
    for variable in ("HOME", "XDG_DATA_HOME", "XDG_CONFIG_HOME", "BLIMP_MODELS"):
        monkeypatch.setenv(variable, str(tmp_path))
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps/atrium").symlink_to(ATRIUM)  # of every checkout
    for give in GIVEN.get(name, []):
        give(tmp_path)
    with quick_light() as patch:
        patch.setattr(flights, "lit_scene", lambda scene, _, light: lit_scene(scene, 25.0, light))
        for words in here(NAMES[name]):
            if name != SIMULATOR or words[1:3] != ["calibrate", "board.mcap"]:
                execute(words, tmp_path)


def execute(words: list[str], folder: Path) -> None:
    """As the words say, in a folder; fails on another status than 0."""
    program, *typed = [*words, *MORE.get(begins(words, MORE) or "", [])]
    if program == "make":
        make(typed, folder)
    elif program == "pi_firmware" or "--page" in typed:
        until_it_runs(program, typed, folder)
    else:
        assert {"blimp": blimp, "hw": hw}[program](typed) == 0, words
        if "--out" in typed:
            assert (folder / typed[typed.index("--out") + 1]).exists(), words


def make(words: list[str], folder: Path) -> None:
    """In the checkout, which is set up; what is named lies in the folder."""
    options = f"--yes --wifi-password-file {folder / 'password'}"
    named = {"DEVICE": "card", "IMAGE": "out/image/blimp-zero2w.img"}
    typed = [
        f"{key}={folder / named[key]}" if (key := word.partition("=")[0]) in named else word
        for word in words
    ]
    if "flash" in words:
        typed.append(f"OPTIONS={options}")
    done = subprocess.run(
        ["make", "-s", "-C", str(ROOT), "-o", "setup", *typed], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def until_it_runs(program: str, words: list[str], folder: Path) -> None:
    """Starts what stays, waits for its first words, looks at the page they name, and ends it."""
    module = {"blimp": "ground_station.cli"}.get(program, program)
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    words = [str(ROOT / word) if word.startswith("pi_firmware/") else word for word in words]
    with subprocess.Popen(
        [sys.executable, "-m", module, *words], cwd=folder, env=environment, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    ) as started:  # fmt: skip
        assert started.stdout is not None
        try:
            said = started.stdout.readline()
            assert started.poll() is None, said
            if "http" in said:
                with urllib.request.urlopen(said.split()[-1], timeout=60) as page:
                    assert page.status == 200
        finally:
            started.send_signal(signal.SIGINT)
            rest = started.communicate(timeout=60)[0]
    assert started.returncode in (0, 130), said + rest
    assert "Traceback" not in rest
