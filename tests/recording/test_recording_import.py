"""A plain video as a recording: its frames, times and camera, and a payload that can play it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numbered_flight import start_payload
from numbered_video import HEIGHT, WIDTH, number_in
from test_recording_video import write_video

from ground_station.cli import main
from ground_station.errors import InputError
from ground_station.geometry.camera import Camera, load_camera
from ground_station.recording.flight import FlightRecording
from ground_station.recording.importing import IDR_NS, import_frames
from ground_station.recording.open import open_input
from pi_firmware.wire import annexb
from pi_firmware.wire.recording import RecordingReader

CAMERA = "width_px = 160\nheight_px = 120\nfx_px = 150\nfy_px = 151\ncx_px = 79.5\ncy_px = 59.5\n"
LENS = "k1 = 0.1\nreadout_s = 0.02\n"
TIMES_MS = [0, 40, 70, 170, 171, 700, 1300, 1366, 1400, 2000]


@pytest.fixture
def camera(tmp_path: Path) -> Path:
    path = tmp_path / "camera.toml"
    path.write_text(CAMERA + LENS)
    return path


@pytest.fixture
def video(tmp_path: Path) -> Path:
    path = tmp_path / "walk.mp4"
    write_video(path, TIMES_MS, {"x264-params": "bframes=3:b-adapt=0"})
    return path


def test_frames_times_and_camera_are_the_videos(
    video: Path, camera: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "walk.mcap"
    assert main(["import", str(video), "--camera", str(camera), "--out", str(out)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == f"next: blimp replay {out} --map maps/NAME"
    source = FlightRecording(out)
    frames = list(source)
    assert [f.time_ns for f in frames] == [ms * 1_000_000 for ms in TIMES_MS]
    assert source.camera == load_camera(camera) and source.notes == []
    for frame, original in zip(frames, open_input(video), strict=True):
        assert number_in(frame.image) == number_in(original.image)
        assert np.abs(frame.image.astype(int) - original.image).mean() < 2.0


def test_its_video_is_as_recordings_have_it(video: Path, camera: Path, tmp_path: Path) -> None:
    """Parameter sets with each IDR, one a second at least, no frame that refers to a later one."""
    out = tmp_path / "walk.mcap"
    import_frames(open_input(video), load_camera(camera), out, name="walk")
    samples = list(RecordingReader(out).video())
    assert [s.time_ns for s in samples] == sorted(s.time_ns for s in samples)
    idr_ns = None
    for sample in samples:
        kinds = set(annexb.nal_types(sample.data))
        if annexb.NAL_IDR in kinds:
            assert {annexb.NAL_SPS, annexb.NAL_PPS} <= kinds
            idr_ns = sample.time_ns
        assert idr_ns is not None and sample.time_ns - idr_ns <= IDR_NS


def test_a_payload_plays_it(video: Path, camera: Path, tmp_path: Path) -> None:
    out = tmp_path / "walk.mcap"
    import_frames(open_input(video), load_camera(camera), out, name="walk")
    process = start_payload(
        f"camera.uri=replay:{out}?pace=stepped", "camera.width_px=160", "camera.height_px=120",
        "link.port=9", "telemetry.enabled=false", "gate.enabled=false",
    )  # fmt: skip
    told, complaint = process.communicate(timeout=60)
    assert process.returncode == 0, complaint
    # A camera of 30 Hz takes one of the two that are 1 ms apart.
    assert "9 captured" in told


def test_a_refusal_is_one_line_and_leaves_nothing(
    video: Path, camera: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "walk.mcap"
    lens = load_camera(camera)
    upright = Camera(HEIGHT, WIDTH, 150, 150, 59.5, 79.5)
    with pytest.raises(InputError, match=r"frame-000000 has 160x120 pixels, .* it lies"):
        import_frames(open_input(video), upright, out, name="walk")
    sides = Camera(WIDTH - 1, HEIGHT, 150, 150, 79, 59.5)
    with pytest.raises(InputError, match=r"159x120, and H\.264 takes even"):
        import_frames(open_input(video), sides, out, name="walk")
    assert not out.exists() and not list(tmp_path.glob("*.part*"))
    import_frames(open_input(video), lens, out, name="walk")
    again = str(tmp_path / "again.mcap")
    assert main(["import", str(out), "--camera", str(camera), "--out", again]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "is a recording already: blimp replay" in said
