"""What a build takes of its inputs: whole where they are short, else keyframes, and clear words."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import cv2
import hand_made
import numpy as np
import pytest
from panning import CAMERA, Place

from ground_station.errors import CameraError, InputError
from ground_station.mapping.construction.inputs import Inputs, open_inputs
from ground_station.mapping.settings import KeyframeSettings, MappingSettings
from ground_station.recording.h264 import H264Encoder
from pi_firmware.wire.recording import RecordingWriter

FRAMES = 36
SETTINGS = MappingSettings(
    keyframes=KeyframeSettings(choose_above=10, parallax_deg=2.0, turn_deg=8.0)
)
START_NS = 1_700_000_000_000_000_000


@pytest.fixture(scope="module")
def pictures() -> list[np.ndarray]:
    """Sideways along a wall, 30 cm in the end."""
    place = Place(7)
    return [place.picture(x_m=0.025 * k) for k in range(FRAMES)]


@pytest.fixture(scope="module")
def units(pictures: list[np.ndarray]) -> list[bytes]:
    encoder = H264Encoder(CAMERA.width_px, CAMERA.height_px, 30, crf=20)
    units = [u for p in pictures for _, u in encoder.encode(np.dstack([p] * 3))]
    return units + [u for _, u in encoder.finish()]


@pytest.fixture
def folder(tmp_path: Path, pictures: list[np.ndarray]) -> Path:
    path = tmp_path / "walk"
    path.mkdir()
    for k, image in enumerate(pictures):
        cv2.imwrite(str(path / f"{k:03d}.png"), image)
    return path


def record(path: Path, units: list[bytes], fx_px: float = CAMERA.fx_px) -> Path:
    with RecordingWriter(path, chunk_bytes=4096) as writer:
        matrix = [fx_px, 0, CAMERA.cx_px, 0, CAMERA.fy_px, CAMERA.cy_px, 0, 0, 1]
        writer.write_calibration(
            START_NS, width_px=320, height_px=240, matrix=matrix, distortion=[0.0] * 5
        )
        for k, unit in enumerate(units):
            writer.write_video(START_NS + k * 33_333_333, unit)
    return path


@pytest.fixture
def camera_file(tmp_path: Path) -> str:
    return hand_made.camera_file(tmp_path / "camera.toml", CAMERA)


def names(inputs: Inputs) -> list[str]:
    return [frame.name for frame in inputs]


def test_a_short_input_is_used_whole_and_read_once(folder: Path, camera_file: str) -> None:
    whole = replace(SETTINGS, keyframes=replace(SETTINGS.keyframes, choose_above=FRAMES))
    inputs = open_inputs([str(folder)], whole, camera=camera_file)
    assert names(inputs) == [f"{k:03d}.png" for k in range(FRAMES)]
    assert inputs.total == FRAMES and not inputs.said and "keyframes" not in inputs.built
    fewer = replace(whole, max_images=8)
    assert len(names(open_inputs([str(folder)], fewer, camera=camera_file))) <= 8


def test_an_input_of_which_most_frames_are_due_is_used_whole(
    folder: Path, camera_file: str
) -> None:
    due = replace(SETTINGS.keyframes, parallax_deg=0.1, turn_deg=0.5)
    inputs = open_inputs([str(folder)], replace(SETTINGS, keyframes=due), camera=camera_file)
    assert names(inputs) == [f"{k:03d}.png" for k in range(FRAMES)]
    assert "keyframes" not in inputs.built
    fewer = replace(SETTINGS, keyframes=due, max_images=FRAMES // 2)
    assert len(names(open_inputs([str(folder)], fewer, camera=camera_file))) <= FRAMES // 2


def test_of_a_longer_one_keyframes_are_taken_with_their_own_names_and_times(
    folder: Path, camera_file: str
) -> None:
    inputs = open_inputs([str(folder)], SETTINGS, camera=camera_file)
    frames = list(inputs)
    assert 2 <= len(frames) < FRAMES / 2 and inputs.total == len(frames)
    for frame in frames:
        assert frame.name == f"{frame.index:03d}.png"
        assert frame.time_ns == round(frame.index * 1e9 / 30)
    assert names(inputs) == [frame.name for frame in frames]  # iterable again
    assert inputs.built["keyframes"]["frames"] == FRAMES
    assert inputs.said[0].startswith(f"{FRAMES} frames; {len(frames)} keyframes")


def test_recordings_and_videos_give_the_same_keyframes(
    tmp_path: Path, folder: Path, units: list[bytes], camera_file: str
) -> None:
    recording = record(tmp_path / "walk.mcap", units)
    stream = tmp_path / "walk.h264"
    stream.write_bytes(b"".join(units))
    recorded = open_inputs([str(recording)], SETTINGS)
    assert recorded.camera == replace(CAMERA)
    indices = [frame.index for frame in recorded]
    assert 2 <= len(indices) < FRAMES / 2
    for frame in recorded:
        assert frame.time_ns == START_NS + frame.index * 33_333_333
    video = open_inputs([str(stream)], SETTINGS, camera=camera_file)
    assert [frame.index for frame in video] == indices
    assert names(video) == [f"frame-{k:06d}" for k in indices]


def test_a_video_that_does_not_tell_its_length_is_used_whole_where_it_is_short(
    tmp_path: Path, units: list[bytes], camera_file: str
) -> None:
    stream = tmp_path / "walk.h264"
    stream.write_bytes(b"".join(units))
    whole = replace(SETTINGS, keyframes=replace(SETTINGS.keyframes, choose_above=FRAMES))
    inputs = open_inputs([str(stream)], whole, camera=camera_file)
    assert inputs.total == FRAMES == len(names(inputs)) and "keyframes" not in inputs.built


def test_a_step_means_exactly_these_frames_and_a_range_bounds_the_choice(
    folder: Path, camera_file: str
) -> None:
    exact = open_inputs([str(folder)], SETTINGS, camera=camera_file, frames="2:30:3")
    assert names(exact) == [f"{k:03d}.png" for k in range(2, 30, 3)] and exact.total == 10
    assert exact.built["range"] == "2:30:3"
    bounded = [f.index for f in open_inputs([str(folder)], SETTINGS, camera=camera_file,
                                            frames="8:28")]  # fmt: skip
    assert 1 <= len(bounded) < 20 and min(bounded) >= 8 and max(bounded) < 28


def test_several_inputs_are_told_apart_by_their_names(
    tmp_path: Path, folder: Path, units: list[bytes], camera_file: str
) -> None:
    recording = record(tmp_path / "flight.mcap", units)
    inputs = open_inputs([str(folder), str(recording)], SETTINGS, camera=camera_file)
    got = names(inputs)
    assert {name.split("/")[0] for name in got} == {"walk", "flight"}
    assert len(set(got)) == len(got) == inputs.total
    twin = tmp_path / "b" / "walk"
    twin.mkdir(parents=True)
    with pytest.raises(InputError, match=r"^two inputs are named 'walk'; "):
        open_inputs([str(folder), str(twin)], SETTINGS, camera=camera_file)


def test_cameras_that_differ_or_only_some_inputs_carry_are_refused(
    tmp_path: Path, folder: Path, units: list[bytes]
) -> None:
    one, other = record(tmp_path / "one.mcap", units), record(tmp_path / "two.mcap", units, 260.0)
    with pytest.raises(CameraError, match=r"two.mcap: was taken by another camera than .*one.mcap"):
        open_inputs([str(one), str(other)], SETTINGS)
    for pair in ((folder, one), (one, folder)):
        with pytest.raises(CameraError, match=r"walk: does not carry a camera, .*--camera$"):
            open_inputs([str(path) for path in pair], SETTINGS)


@pytest.mark.parametrize("choose_above", [10, 100])
def test_an_unreadable_image_is_named(folder: Path, camera_file: str, choose_above: int) -> None:
    (folder / "017.png").write_bytes(b"no image")
    settings = replace(SETTINGS, keyframes=replace(SETTINGS.keyframes, choose_above=choose_above))
    with pytest.raises(InputError, match=r"017.png: not a whole, readable image$"):
        list(open_inputs([str(folder)], settings, camera=camera_file))


def test_what_cannot_be_read_twice_is_refused(tmp_path: Path, camera_file: str) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="pipe or device cannot be read twice"):
        open_inputs([str(tmp_path / "pipe")], SETTINGS, camera=camera_file)


def test_an_input_that_changes_between_the_readings_is_said_to(
    tmp_path: Path, units: list[bytes]
) -> None:
    recording = record(tmp_path / "walk.mcap", units)
    inputs = open_inputs([str(recording)], SETTINGS)
    record(recording, units[:12])
    with pytest.raises(InputError, match=r"walk.mcap: gave \d+ of the \d+ frames that were chosen"):
        list(inputs)


def test_the_notes_of_a_cut_recording_are_those_of_the_whole_reading(
    tmp_path: Path, units: list[bytes]
) -> None:
    recording = record(tmp_path / "walk.mcap", units)
    recording.write_bytes(recording.read_bytes()[:-4000])
    inputs = open_inputs([str(recording)], SETTINGS)
    given = len(names(inputs))
    assert len(inputs.notes) == 1 and "cut" in inputs.notes[0]
    assert f"{given} frames read" not in inputs.notes[0]
