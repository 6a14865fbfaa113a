"""A hand-held video that no one here made becomes a map that agrees with its ground truth."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hand_made import run

from ground_station.commands import maps
from ground_station.geometry.alignment import align
from ground_station.geometry.camera import load_camera
from ground_station.geometry.trajectory import read_tum
from ground_station.localization.extraction import extractor_for
from ground_station.localization.localizer import Localizer
from ground_station.localization.settings import load_preset
from ground_station.map import store
from ground_station.recording.frames import FrameRange
from ground_station.recording.open import open_input

DATA = Path(__file__).parents[3] / "../shared/data/redkitchen"

needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="../shared/data/redkitchen is not there")


@needs_data
def test_twelve_frames_of_a_kitchen_are_one_map_within_two_centimetres(tmp_path):
    folder = tmp_path / "kitchen"
    arguments = ("build", DATA / "frames", "--camera", DATA / "camera.toml", "--range", "0:144:12")
    assert run(maps, *arguments, "--out", folder) == 0
    map_ = store.load(folder)
    assert map_.keyframes.names[:2] == ["frame-000000.jpg", "frame-000012.jpg"]
    assert len(map_.keyframes) == 12
    assert map_.keyframes.time_ns[1] == pytest.approx(12 / 30 * 1e9, abs=1)
    truth = read_tum(DATA / "pseudo_groundtruth.txt")
    nearest = [truth.nearest(int(t)) for t in map_.keyframes.time_ns]
    centres, positions = map_.keyframes.wTc[:, :3, 3], truth.position_m[nearest]
    fit = align(centres, positions, True)
    assert np.linalg.norm(fit.apply(centres) - positions, axis=1).max() < 0.02
    report = tmp_path / "register.json"
    trajectory = DATA / "pseudo_groundtruth.txt"
    assert run(maps, "register", folder, "--trajectory", trajectory, "--json", report) == 0
    assert json.loads(report.read_text())["residual_rms_m"] < 0.01
    assert store.load_info(folder).registered


@needs_data
def test_thirteen_frames_of_a_kitchen_place_nine_in_ten_of_another_pass(tmp_path):
    """Of a thin map a picture shows few landmarks: a prediction says the rest."""
    folder, truth = tmp_path / "kitchen", DATA / "official_groundtruth.txt"
    arguments = ("build", DATA / "frames", "--camera", DATA / "camera.toml", "--range", "0:500:40")
    assert run(maps, *arguments, "--out", folder) == 0
    assert run(maps, "register", folder, "--trajectory", truth) == 0
    map_, camera, settings = (
        store.load(folder),
        load_camera(DATA / "camera.toml"),
        load_preset("default"),
    )
    localizer = Localizer(map_, camera, extractor_for(map_.info, settings.features), settings)
    poses, off_m = read_tum(truth), []
    frames = list(open_input(DATA / "frames", 30.0, FrameRange(500, 760, 10)))
    for frame in frames:
        found = localizer.process(frame.time_ns, frame.image, frame.index, frame.exposure_s).wTc
        if found is not None:
            off_m.append(
                np.linalg.norm(found[:3, 3] - poses.position_m[poses.nearest(frame.time_ns)])
            )
    assert len(off_m) >= 0.9 * len(frames)
    assert np.median(off_m) < 0.01 and max(off_m) < 0.1


@needs_data
def test_a_right_lens_is_kept_where_the_camera_s_motion_looks_like_another(tmp_path):
    folder = tmp_path / "kitchen"
    arguments = ("build", DATA / "frames", "--camera", DATA / "camera.toml", "--range", "0:192:12")
    assert run(maps, *arguments, "--out", folder) == 0
    lens = store.load_info(folder).built["lens"]
    assert lens["state"] == "kept" and "rolling shutter" in lens["said"]
    assert store.load(folder).info.camera == load_camera(DATA / "camera.toml")
