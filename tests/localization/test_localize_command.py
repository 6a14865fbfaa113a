"""`blimp localize` from arguments to files."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from synthetic import keyframes_of, landmarks_at, unit

from ground_station.errors import CameraError
from ground_station.features.extractors import create
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.geometry.trajectory import Trajectory, read_tum, write_tum
from ground_station.localization import command
from ground_station.localization.localizer import LocalizationError, Localizer
from ground_station.map import store
from ground_station.map.observations import landmarks_sha256, load_observations
from ground_station.map.store import Map, MapInfo, save_tables
from pi_firmware.wire.errors import BlimpError


def _texture(rng: np.random.Generator) -> np.ndarray:
    """A grey picture of 900x700 with corners at several scales."""
    image = np.zeros((700, 900), np.float32)
    for size, weight in ((9, 0.3), (23, 0.5), (60, 1.0)):
        cells = rng.normal(size=(700 // size + 2, 900 // size + 2)).astype(np.float32)
        image += weight * cv2.resize(cells, (900, 700), interpolation=cv2.INTER_CUBIC)
    return cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


@pytest.fixture(scope="module")
def flight(tmp_path_factory) -> Path:
    """Six pictures of a textured plane 2 m ahead and a map of it, with the true trajectory.

    The camera slides 1 cm a frame to the right: the picture moves by 2.5 px.
    """
    folder = tmp_path_factory.mktemp("flight")
    rng = np.random.default_rng(5)
    wall = _texture(rng)
    frames = folder / "frames"
    frames.mkdir()
    shifts = [2.5 * k for k in range(6)]
    for k, shift in enumerate(shifts):
        move = np.array([[1.0, 0, -100 - shift], [0, 1, -100]])
        cv2.imwrite(str(frames / f"{k:03d}.png"), cv2.warpAffine(wall, move, (640, 480)))
    camera = Camera(fx_px=500, fy_px=500, cx_px=320, cy_px=240)
    extractor = create("rootsift", 800)
    image = cv2.imread(str(frames / "000.png"), cv2.IMREAD_GRAYSCALE)
    features = extractor.extract(image)
    count = len(features)
    points = np.c_[(features.keypoints_px - [320, 240]) / 500 * 2.0, np.full(count, 2.0)]
    landmarks = landmarks_at(
        points,
        features.descriptors,
        covariance_m2=np.tile(np.eye(3, dtype=np.float32) * 1e-6, (count, 1, 1)),
        view_direction=unit(-points),
        view_cos=np.ones(count, np.float32),
        distance_m=np.full((count, 2), 2.0, np.float32),
    )
    keyframes = keyframes_of(np.eye(4)[None], [np.arange(count)])
    info = MapInfo("rootsift", extractor.sha256, 128, camera, name="wall", frame="world", units="m")
    (folder / "map").mkdir()
    save_tables(folder / "map", Map(info, landmarks, keyframes))
    truth = np.stack([poses.pose(np.eye(3), [0.01 * k, 0, 0]) for k in range(6)])
    times = np.array([round(k / 30 * 1e9) for k in range(6)])
    write_tum(folder / "truth.txt", Trajectory.from_poses(times, truth))
    return folder


def _args(flight, tmp_path, *more) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    base = [str(flight / "frames"), "--map", str(flight / "map")]
    return parser.parse_args([*base, "--out", str(tmp_path / "est.txt"), *more])


@pytest.mark.parametrize("preset", ["default", "thesis"])
def test_a_folder_becomes_a_trajectory_and_figures(flight, tmp_path, preset):
    out = tmp_path / "est.json"
    first = ["--init", str(flight / "truth.txt")]
    more = ["--preset", preset, "--min-entropy-bits", "0", "--json", str(out), *first]
    assert command.run(_args(flight, tmp_path, *more)) == 0
    estimate, truth = read_tum(tmp_path / "est.txt"), read_tum(flight / "truth.txt")
    assert estimate.time_ns.tolist() == truth.time_ns.tolist()
    assert np.abs(estimate.position_m - truth.position_m).max() < 0.01
    figures = json.loads(out.read_text())
    assert figures["frames"] == {"captured": 6, "gated": 0, "received": 6, "localized": 6}
    assert figures["states"]["TRACKING"] == 6 and figures["seed"] == 0
    assert set(figures["latency_ms"]) == {"p50", "p99"}
    assert {"features", "projection", "association", "pose", "total"} <= set(figures["stage_ms"])
    assert figures["preset"] == preset and figures["frame"] == "world"


@pytest.mark.parametrize("size", [(1280, 960), (320, 240)])
def test_pictures_of_another_size_are_localized_with_the_camera_scaled(
    flight, tmp_path, capsys, size
):
    (tmp_path / "frames").mkdir()
    for path in sorted((flight / "frames").iterdir()):
        image = cv2.resize(cv2.imread(str(path)), size, interpolation=cv2.INTER_LINEAR)
        cv2.imwrite(str(tmp_path / "frames" / path.name), image)
    args = _args(flight, tmp_path, "--init", str(flight / "truth.txt"))
    args.input = str(tmp_path / "frames")
    assert command.run(args) == 0
    estimate, truth = read_tum(tmp_path / "est.txt"), read_tum(flight / "truth.txt")
    assert len(estimate) == len(truth)
    assert np.abs(estimate.position_m - truth.position_m).max() < 0.02
    assert f"its pictures are {size[0]}x{size[1]}" in capsys.readouterr().err


def test_pictures_of_another_shape_are_refused_with_what_to_do(flight, tmp_path):
    (tmp_path / "frames").mkdir()
    cv2.imwrite(str(tmp_path / "frames" / "0.png"), np.zeros((640, 480), np.uint8))
    args = _args(flight, tmp_path)
    args.input = str(tmp_path / "frames")
    with pytest.raises(CameraError, match=r"480x640, the .*blimp calibrate"):
        command.run(args)


def test_smoothed_poses_go_to_a_file_of_their_own(flight, tmp_path):
    smoothed = tmp_path / "smoothed.txt"
    more = ["--init", str(flight / "truth.txt"), "--smoothed", str(smoothed)]
    assert command.run(_args(flight, tmp_path, *more)) == 0
    causal, later = read_tum(tmp_path / "est.txt"), read_tum(smoothed)
    assert later.time_ns.tolist() == causal.time_ns.tolist()
    assert not np.array_equal(later.position_m, causal.position_m)
    assert np.abs(later.position_m - read_tum(flight / "truth.txt").position_m).max() < 0.01
    with pytest.raises(LocalizationError, match="--smoothed: only the solver 'rolling'"):
        command.run(_args(flight, tmp_path, *more, "--preset", "thesis"))


def test_what_was_seen_is_written_for_the_maps_refinement(flight, tmp_path):
    out = tmp_path / "seen.safetensors"
    more = ["--init", str(flight / "truth.txt"), "--observations", str(out)]
    assert command.run(_args(flight, tmp_path, *more)) == 0
    seen, map_ = load_observations(out), store.load(flight / "map")
    assert seen.name == "frames" and seen.map == "wall" and seen.camera == map_.info.camera
    assert seen.landmarks_sha256 == landmarks_sha256(map_.landmarks)
    estimate = read_tum(tmp_path / "est.txt")
    assert np.isin(seen.time_ns, estimate.time_ns).all() and len(seen) >= 4
    for k in range(len(seen)):
        rows = slice(seen.offset[k], seen.offset[k + 1])
        points = map_.landmarks.position_m[np.searchsorted(map_.landmarks.id, seen.landmark[rows])]
        pixel = seen.camera.project(poses.transform(poses.inverse(seen.wTc[k]), points))
        assert len(points) > 20
        assert np.median(np.linalg.norm(pixel - seen.pixel_px[rows], axis=1)) < 1.0


def test_without_a_first_pose_the_default_finds_it_in_the_map(flight, tmp_path):
    assert command.run(_args(flight, tmp_path, "--range", "1:4")) == 0
    estimate = read_tum(tmp_path / "est.txt")
    assert np.allclose(estimate.position_m[:, 0], [0.01, 0.02, 0.03], atol=0.01)
    assert estimate.time_ns.tolist() == [33_333_333, 66_666_667, 100_000_000]


def test_gated_frames_are_counted_and_have_no_poses(flight, tmp_path):
    out = tmp_path / "est.json"
    more = ["--min-entropy-bits", "8", "--json", str(out)]
    assert command.run(_args(flight, tmp_path, *more)) == 1
    figures = json.loads(out.read_text())
    assert figures["frames"] == {"captured": 6, "gated": 6, "received": 6, "localized": 0}
    assert figures["latency_ms"] == {}


def test_an_interrupted_run_writes_what_was_finished(flight, tmp_path, monkeypatch):
    process = Localizer.process

    def interrupted(self, time_ns, image, index=0, exposure_s=None):
        if index == 3:
            raise KeyboardInterrupt
        return process(self, time_ns, image, index)

    monkeypatch.setattr(Localizer, "process", interrupted)
    out = tmp_path / "est.json"
    assert command.run(_args(flight, tmp_path, "--json", str(out))) == 130
    assert len(read_tum(tmp_path / "est.txt")) == 3
    assert json.loads(out.read_text())["interrupted"] is True


@pytest.mark.parametrize(
    ("more", "text"),
    [
        (["--min-entropy-bits", "9"], "min-entropy-bits"),
        (["--init", "absent.txt"], "absent.txt"),
        (["--range", "90:95"], "90:95"),
        (["--preset", "absent.toml"], "absent.toml"),
        (["--preset", "own.toml"], r"association\.radius"),
        (["--preset", "thesis"], "--init"),
        (["--out", "absent/est.txt"], "folder does not exist"),
    ],
)
def test_bad_arguments_are_one_line_that_names_them(flight, tmp_path, monkeypatch, more, text):
    monkeypatch.chdir(tmp_path)
    Path("own.toml").write_text("[association]\nradius = 3\n")
    with pytest.raises(BlimpError, match=text) as caught:
        command.run(_args(flight, tmp_path, *more))
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "est.txt").exists()


def test_help_imports_nothing_heavy():
    code = (
        "import argparse, sys; from ground_station.localization import command;"
        "command.add_arguments(argparse.ArgumentParser());"
        "print([m for m in ('numpy', 'cv2', 'gtsam', 'scipy') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
