"""What bad input gets, through the real programs: one line that names it, and exit status 2."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from ground_station.geometry.camera import THESIS_CAMERA
from pi_firmware.wire.recording import RecordingWriter

ROOT = Path(__file__).parents[2]
BLIMP = Path(sys.executable).with_name("blimp")
STREAMS = ROOT / ".." / "shared" / "data" / "streams"
CAMERA = """\
width_px = 640
height_px = 480
fx_px = {fx}
fy_px = 500.0
cx_px = 320.0
cy_px = 240.0
"""


def refuse(*command: object, env: dict[str, str] | None = None) -> str:
    """Runs a command that must fail as promised, and gives its line without the program's name."""
    run = subprocess.run(
        [str(word) for word in command],
        capture_output=True,
        text=True,
        timeout=120,
        cwd=ROOT,
        env={**os.environ, **(env or {})},
    )
    lines = run.stderr.strip().splitlines()
    assert run.returncode == 2, f"status {run.returncode}: {run.stderr}"
    assert len(lines) == 1, run.stderr
    return lines[0]


@pytest.fixture
def camera(tmp_path: Path) -> Path:
    path = tmp_path / "camera.toml"
    path.write_text(CAMERA.format(fx=500.0))
    return path


def images(folder: Path, count: int, size: tuple[int, int] = (480, 640)) -> Path:
    folder.mkdir()
    for k in range(count):
        noise = np.random.default_rng(k).integers(0, 255, size, dtype=np.uint8)
        cv2.imwrite(str(folder / f"{k:03}.png"), cv2.GaussianBlur(noise, (0, 0), 2))
    return folder


def test_a_missing_recording(tmp_path: Path) -> None:
    for command in (("map", "build", "--out", tmp_path / "map"), ("replay", "--map", tmp_path)):
        assert "nowhere.mcap: No such file" in refuse(BLIMP, *command, tmp_path / "nowhere.mcap")


def test_a_file_that_is_no_recording(tmp_path: Path) -> None:
    fake = tmp_path / "fake.mcap"
    fake.write_bytes(os.urandom(4096))
    line = refuse(BLIMP, "map", "build", fake, "--out", tmp_path / "map")
    assert "fake.mcap: no MCAP recording" in line


def test_a_recording_cut_before_its_first_frame(tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    with RecordingWriter(path) as writer:
        writer.write_calibration(
            0,
            width_px=640,
            height_px=480,
            matrix=THESIS_CAMERA.matrix.ravel().tolist(),
            distortion=THESIS_CAMERA.distortion.tolist(),
        )
    path.write_bytes(path.read_bytes()[:100])
    assert "cut.mcap: " in refuse(BLIMP, "map", "build", path, "--out", tmp_path / "map")


def test_a_folder_without_images(tmp_path: Path, camera: Path) -> None:
    (tmp_path / "empty").mkdir()
    line = refuse(
        BLIMP, "map", "build", tmp_path / "empty", "--camera", camera, "--out", tmp_path / "map"
    )
    assert "empty" in line and "no images" in line


def test_images_that_do_not_overlap(tmp_path: Path, camera: Path) -> None:
    folder, out = images(tmp_path / "noise", 3), tmp_path / "map"
    run = subprocess.run(
        [BLIMP, "map", "build", folder, "--camera", camera, "--out", out],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert run.returncode == 2 and "overlap" in run.stderr.strip().splitlines()[-1]
    assert "Traceback" not in run.stderr and not out.exists()


@pytest.mark.skipif(not STREAMS.is_dir(), reason="../shared/data/streams is not there")
def test_a_stream_without_parameter_sets(tmp_path: Path, camera: Path) -> None:
    stream = STREAMS / "tello-no-parameter-sets.h264"
    line = refuse(BLIMP, "map", "build", stream, "--camera", camera, "--out", tmp_path / "map")
    assert "no H.264 parameter sets (SPS/PPS)" in line


def test_a_camera_file_with_a_nan(tmp_path: Path) -> None:
    path = tmp_path / "camera.toml"
    path.write_text(CAMERA.format(fx="nan"))
    folder = images(tmp_path / "images", 2)
    line = refuse(BLIMP, "map", "build", folder, "--camera", path, "--out", tmp_path / "map")
    assert "camera.toml: 'fx_px' must be a finite number, not nan" in line


def test_a_map_built_with_other_features(tmp_path: Path, small_map: Path, camera: Path) -> None:
    copy = tmp_path / "other"
    shutil.copytree(small_map, copy)
    text = (copy / "map.toml").read_text()
    (copy / "map.toml").write_text(text.replace('name = "rootsift"', 'name = "nobodys"'))
    folder = images(tmp_path / "images", 2)
    line = refuse(
        BLIMP, "localize", folder, "--map", copy, "--camera", camera, "--init", "none",
        "--out", tmp_path / "estimate.txt",
    )  # fmt: skip
    assert "built with 'nobodys'" in line and "not here (there are: " in line and "rootsift" in line


def test_a_map_that_is_cut(tmp_path: Path, small_map: Path, camera: Path) -> None:
    copy = tmp_path / "cut"
    shutil.copytree(small_map, copy)
    table = copy / "landmarks.safetensors"
    table.write_bytes(table.read_bytes()[:-10])
    folder = images(tmp_path / "images", 2)
    line = refuse(
        BLIMP, "localize", folder, "--map", copy, "--camera", camera, "--init", "none",
        "--out", tmp_path / "estimate.txt",
    )  # fmt: skip
    assert "landmarks.safetensors" in line


def test_a_trajectory_that_is_none(tmp_path: Path) -> None:
    estimate = tmp_path / "estimate.txt"
    estimate.write_text("0.0 1 2 3 0 0 0 1\n0.1 1 2 nan 0 0 0 1\n")
    assert "estimate.txt, line 2: " in refuse(BLIMP, "evaluate", estimate, estimate)


def test_a_port_in_use(tmp_path: Path) -> None:
    """Telemetry that cannot listen says which port, and the payload does not start."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        line = refuse(
            sys.executable, "-m", "pi_firmware", "--set", f'telemetry.listen=["{endpoint}"]',
            "--set", "camera.uri=test:?duration_s=1",
        )  # fmt: skip
    assert endpoint in line and "in use" in line


def test_an_encoder_that_is_not_installed() -> None:
    """An empty plugin path is a machine without GStreamer's plugins."""
    line = refuse(
        sys.executable, "-m", "pi_firmware", "--set", "camera.uri=test:?duration_s=1",
        env={"GST_PLUGIN_SYSTEM_PATH_1_0": "", "GST_PLUGIN_PATH_1_0": "",
             "GST_REGISTRY_1_0": os.devnull, "GST_REGISTRY_FORK": "no"},
    )  # fmt: skip
    assert "no element 'x264enc'" in line and "gstreamer1.0-plugins-ugly" in line


def test_a_payload_configuration_with_a_wrong_key(tmp_path: Path) -> None:
    path = tmp_path / "payload.toml"
    path.write_text("[camera]\nurl = 'test:'\n")
    line = refuse(sys.executable, "-m", "pi_firmware", "--config", path)
    assert "unknown key 'camera.url'" in line
