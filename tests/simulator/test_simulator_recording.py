"""A simulated flight as a recording: complete, exact, reproducible, readable by others."""

from __future__ import annotations

import json
import math
import signal
import subprocess
import sys
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import yaml
from quick_flight import arguments, asked_for, quick_settings

from ground_station.geometry import poses
from ground_station.geometry.camera import THESIS_CAMERA
from ground_station.geometry.trajectory import read_tum
from ground_station.recording.open import open_input
from ground_station.simulator import command, scenes
from ground_station.simulator.known_points import project_rolling
from ground_station.simulator.sample import write_floorplan
from ground_station.simulator.scene import SimulatorError
from ground_station.simulator.simulate import prepare_flight, simulate, time_ns_of
from pi_firmware.wire.recording import (
    FRAME_INFO_TOPIC,
    TRUTH_TOPIC,
    RecordingReader,
)


def pictures(path: Path) -> list[np.ndarray]:
    decoder = av.CodecContext.create("h264", "r")
    frames = []
    for sample in RecordingReader(path).video():
        frames += decoder.decode(av.Packet(sample.data))
    frames += decoder.decode(None)
    return [f.to_ndarray(format="rgb24") for f in frames]


def test_every_frame_has_its_picture_pose_and_info_at_one_time(flight: Path) -> None:
    reader = RecordingReader(flight)
    video = [s.time_ns for s in reader.video()]
    truth = [p.time_ns for p in reader.poses(TRUTH_TOPIC)]
    info = list(reader.json(FRAME_INFO_TOPIC))
    assert not reader.cut
    assert video == truth == [t for t, _ in info]
    assert video == [1_000_000_000 + 200_000_000 * k for k in range(4)]
    assert [i["sequence"] for _, i in info] == [0, 1, 2, 3]
    assert all(0 < i["exposure_s"] <= 1 / 60 and i["gain"] >= 1 for _, i in info)
    assert len(pictures(flight)) == 4


def test_the_truth_is_the_motion_at_the_frames_times(flight: Path) -> None:
    prepared = prepare_flight(quick_settings(flight))
    truth = RecordingReader(flight).poses(TRUTH_TOPIC)
    assert [p.time_ns for p in truth] == time_ns_of(prepared.times_s).tolist()
    expected = prepared.motion.wTc(prepared.times_s)
    for sample, wTc in zip(truth, expected, strict=True):
        got = poses.from_quaternion(sample.position_m, sample.quaternion_xyzw)
        assert np.abs(got - wTc).max() < 1e-12


def test_it_carries_the_thesis_camera_and_the_seed(flight: Path) -> None:
    reader = RecordingReader(flight)
    calibration = reader.calibration()
    assert calibration is not None
    assert (calibration.width, calibration.height) == (640, 480)
    assert list(calibration.K) == [501.58, 0, 312.51, 0, 505.57, 241.21, 0, 0, 1]
    assert list(calibration.D) == [0.1673, -0.2605, -1.3e-5, -0.00203, 0.0]
    reader.topics()
    assert set(reader.metadata["camera"]) == set(THESIS_CAMERA.as_dict())
    assert float(reader.metadata["camera"]["readout_s"]) == 0.020
    simulation = reader.metadata["simulation"]
    assert (simulation["seed"], simulation["scene"], simulation["plan"]) == ("5", "atrium", "loop")
    assert reader.metadata["simulation_end"] == {"frames": "4", "interrupted": "false"}


def test_an_idr_comes_at_least_every_second(tmp_path: Path) -> None:
    out = tmp_path / "f.mcap"
    simulate(quick_settings(out, duration_s=2.2, rate_hz=2.5, supersampling=0.25))
    idr = []
    for sample in RecordingReader(out).video():
        kinds = [unit[0] & 31 for unit in sample.data.split(b"\x00\x00\x01")[1:]]
        if 5 in kinds:
            assert {7, 8} <= set(kinds)
            idr.append(sample.time_ns)
    assert np.diff(idr).max() <= 1_000_000_000


def test_a_seed_gives_its_recording_again_and_another_seed_another(
    flight: Path, tmp_path: Path
) -> None:
    again, other = tmp_path / "again.mcap", tmp_path / "other.mcap"
    simulate(quick_settings(again))
    simulate(quick_settings(other, seed=6, duration_s=0.2))
    assert again.read_bytes() == flight.read_bytes()
    a, b = pictures(flight)[0].astype(float), pictures(other)[0].astype(float)
    assert np.abs(a - b).mean() > 5


def test_observations_of_known_points_reproject_and_spread(tmp_path: Path) -> None:
    out, pairs, tum = tmp_path / "m.mcap", tmp_path / "PAIRS.csv", tmp_path / "t.txt"
    settings = quick_settings(
        out, plan="mapping", duration_s=100.0, rate_hz=0.3, points=pairs, truth=tum,
        supersampling=0.25,
    )  # fmt: skip
    result = simulate(settings)
    assert len(read_tum(tum)) == result.frames == 30
    motion = prepare_flight(settings).motion
    lines = pairs.read_text().splitlines()
    assert lines[0] == "point,image,u_px,v_px,x_m,y_m,z_m"
    errors: list[float] = []
    seen: dict[str, list[int]] = {}
    where: dict[str, list[float]] = {}
    for line in lines[1:]:
        name, image, *numbers = line.split(",")
        u, v, x, y, z = map(float, numbers)
        assert image.startswith("frame-")
        frame = int(image.removeprefix("frame-"))
        assert image == f"frame-{frame:06d}"
        (pixel,) = project_rolling(THESIS_CAMERA, motion, frame / 0.3, [[x, y, z]])
        errors += [u - float(pixel[0]), v - float(pixel[1])]
        seen.setdefault(name, []).append(frame)
        where[name] = [x, y, z]
    assert 12 <= len(seen) <= 20
    assert all(len(set(frames)) == len(frames) >= 3 for frames in seen.values())
    assert 0.2 < np.std(errors) < 0.4  # a person's click
    assert np.abs(errors).max() < 1.5
    spread = np.linalg.svd(np.array(list(where.values())) - np.mean(list(where.values()), axis=0))[
        1
    ]
    assert spread[2] / math.sqrt(len(where)) > 0.7  # in no plane


def test_an_interrupt_keeps_what_was_taken(tmp_path: Path) -> None:
    out = tmp_path / "f.mcap"

    def interrupt(done: int, total: int) -> None:
        if done == 2:
            signal.raise_signal(signal.SIGINT)

    result = simulate(quick_settings(out, supersampling=0.25), interrupt)
    assert result.interrupted
    assert result.frames == 2
    reader = RecordingReader(out)
    assert reader.topics() == {
        "/camera/calibration": 1, "/truth/pose": 2, "/camera/frame": 2, "/camera/video": 2,
    }  # fmt: skip
    assert not reader.cut
    assert reader.metadata["simulation_end"]["interrupted"] == "true"
    assert [p.name for p in tmp_path.iterdir()] == ["f.mcap"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"plan": "zigzag"},
            "plan 'zigzag' is unknown; there are: mapping, loop, small-circle, fast, corridor, "
            "stills, headset, walk, tour, board",
        ),
        (
            {"light": "moon"},
            "light 'moon' is unknown; there are: noon, cloudy, evening, sunset, 0h to 23h",
        ),
        (
            {"light": "24h"},
            "light '24h' is unknown; there are: noon, cloudy, evening, sunset, 0h to 23h",
        ),
        (
            {"scene": "cave"},
            "scene 'cave' is unknown; there are: atrium, office, corridor, hall, hall-glazed, "
            "hall-above, hall-above-alike, rooms, board, atrium-moved-25, atrium-moved-50, "
            "atrium-moved, "
            "atrium-moved-posted, interior-N, passage-N, stairwell-N",
        ),
        ({"rate_hz": math.nan}, "rate_hz is nan; allowed: 0.1 to 120"),
        ({"duration_s": -1.0}, "duration_s is -1; allowed: above 0 to 3600"),
        (
            {"plan": "headset"},
            "plan 'headset' walks through doorways; scene 'atrium' has none: --scene rooms",
        ),
        ({"crf": 90.0}, "crf is 90.0; allowed: 0 to 51"),
        ({"processing": "raw"}, "processing 'raw' is unknown; there are: none, camera"),
    ],
)
def test_bad_settings_are_refused_in_one_line(
    tmp_path: Path, change: dict[str, object], message: str
) -> None:
    with pytest.raises(SimulatorError) as caught:
        simulate(quick_settings(tmp_path / "f.mcap", **change))
    assert str(caught.value) == message
    assert not list(tmp_path.iterdir())


def test_the_command_parses_without_loading_anything_heavy() -> None:
    code = (
        "import argparse, sys\n"
        "from ground_station.simulator import command\n"
        "p = argparse.ArgumentParser(); command.add_arguments(p); p.format_help()\n"
        "print(sorted({'mujoco', 'cv2', 'av', 'scipy', 'numpy'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_command_writes_the_recording_and_its_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out, report = tmp_path / "f.mcap", tmp_path / "f.json"
    args = arguments("--out", str(out), "--json", str(report), "--seed", "5")
    monkeypatch.setattr(command, "settings_from", lambda a: quick_settings(a.out, duration_s=0.2))
    assert command.run(args) == 0
    document = json.loads(report.read_text())
    assert (document["frames"], document["seed"], document["plan"]) == (1, 5, "loop")
    assert document["bytes"] == out.stat().st_size
    assert "1 frames" in capsys.readouterr().out
    with pytest.raises(SimulatorError, match="--out is missing"):
        command.run(arguments())


def test_the_floor_plan_is_what_map_server_reads(tmp_path: Path) -> None:
    scene = scenes.build("atrium", 10)
    write_floorplan(tmp_path, scene)
    document = yaml.safe_load((tmp_path / "floorplan.yaml").read_text())
    assert list(document) == [
        "image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh",
    ]  # fmt: skip
    plan = cv2.imread(str(tmp_path / document["image"]), cv2.IMREAD_UNCHANGED)
    assert plan.ndim == 2

    def at(x_m: float, y_m: float) -> int:
        x0, y0, _ = document["origin"]
        column = int((x_m - x0) / document["resolution"])
        row = plan.shape[0] - 1 - int((y_m - y0) / document["resolution"])
        return int(plan[row, column])

    assert at(12.0, 8.5) == 254  # open floor
    assert at(-0.1, 8.0) == 0  # west wall
    assert at(1.5, 2.2) == 0  # a pillar
    assert at(1.5, 5.0) == 254
    assert at(-0.6, -0.6) == 205  # outside
    assert at(20.0, 9.0) == 0  # reception


def test_unsteady_light_and_exposure_are_shown_and_told(tmp_path: Path) -> None:
    given = "--exposure-steps 0.2:1,0.4:-1 --light-steps 0.5:0.01 --flicker 0.5"
    asked = asked_for(*given.split(), "--longest-exposure-s", "0.002")
    names = ("exposure_steps", "light_steps", "flicker", "longest_exposure_s")
    out = tmp_path / "f.mcap"
    simulate(quick_settings(out, **{name: getattr(asked, name) for name in names}))
    reader = RecordingReader(out)
    info = [frame for _, frame in reader.json(FRAME_INFO_TOPIC)]
    taken = np.array([frame["exposure_s"] * frame["gain"] for frame in info])
    assert all(frame["exposure_s"] == 0.002 < 0.002 * frame["gain"] for frame in info)
    # Auto exposure drifts a little as the camera moves.
    assert np.log2(taken[1:3] / taken[:2]) == pytest.approx([1, -2], abs=0.3)
    shown = [picture.mean() for picture in pictures(out)]
    assert shown[1] > 1.15 * shown[0] and shown[2] < 0.75 * shown[0] and shown[3] < 0.2 * shown[0]
    reader.topics()
    simulation = reader.metadata["simulation"]
    assert [simulation[name] for name in names] == ["0.2:1,0.4:-1", "0.5:0.01", "0.5", "0.002"]


def test_a_cameras_processing_is_named_and_changes_pictures_only(
    flight: Path, tmp_path: Path
) -> None:
    out = tmp_path / "f.mcap"
    simulate(quick_settings(out, processing=asked_for("--processing", "camera").processing))
    plain, processed = RecordingReader(flight), RecordingReader(out)
    assert processed.poses(TRUTH_TOPIC) == plain.poses(TRUTH_TOPIC)
    assert [s.data for s in processed.video()] != [s.data for s in plain.video()]
    named = processed.metadata_table("simulation")
    assert named == plain.metadata_table("simulation") | {"processing": "camera"}
    # What is not asked for is not named: flights of before are the same, byte for byte.
    assert set(plain.metadata_table("simulation")) == {
        "seed", "scene", "plan", "light", "rate_hz", "duration_s", "version",
    }  # fmt: skip


def test_the_light_changes_colour_contrast_and_exposure(flight: Path, tmp_path: Path) -> None:
    sunset = tmp_path / "sunset.mcap"
    simulate(quick_settings(sunset, light="sunset", duration_s=0.2))
    noon_picture, sunset_picture = pictures(flight)[0], pictures(sunset)[0]
    for picture in (noon_picture, sunset_picture):
        assert 60 < picture.mean() < 190

    def warmth(picture: np.ndarray) -> float:
        return float(picture[..., 0].mean() / picture[..., 2].mean())

    def light_taken(path: Path) -> float:
        _, info = next(iter(RecordingReader(path).json(FRAME_INFO_TOPIC)))
        return float(info["exposure_s"] * info["gain"])

    assert warmth(sunset_picture) > 1.15 * warmth(noon_picture)
    assert light_taken(sunset) > 2 * light_taken(flight)


def test_people_are_seen_and_move_and_nothing_else_changes(flight: Path, tmp_path: Path) -> None:
    out = tmp_path / "crowded.mcap"
    simulate(quick_settings(out, people=30))
    empty, crowded = (
        [frame.image.astype(int) for frame in open_input(path)] for path in (flight, out)
    )
    changed = [np.abs(a - b) > 40 for a, b in zip(empty, crowded, strict=True)]
    # They hide some of the picture, and of what lies above their heads nothing.
    assert all(0.002 < one.mean() < 0.4 for one in changed)
    assert not any(one[:100].any() for one in changed)
    assert (changed[0] != changed[-1]).mean() > 0.002
