"""A hand-held video that no one here made becomes a map that agrees with its ground truth."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import pytest

from ground_station.commands import maps
from ground_station.geometry.alignment import align
from ground_station.geometry.trajectory import read_tum
from ground_station.map import store

DATA = Path(__file__).parents[3] / "../shared/data/redkitchen"

needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="../shared/data/redkitchen is not there")


def _run(*words: object) -> int:
    parser = argparse.ArgumentParser()
    maps.add_arguments(parser)
    return maps.run(parser.parse_args([str(word) for word in words]))


@needs_data
def test_twelve_frames_of_a_kitchen_are_one_map_within_two_centimetres(tmp_path):
    folder = tmp_path / "kitchen"
    arguments = ("build", DATA / "frames", "--camera", DATA / "camera.toml", "--range", "0:144:12")
    assert _run(*arguments, "--out", folder) == 0
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
    assert _run("register", folder, "--trajectory", trajectory, "--json", report) == 0
    assert json.loads(report.read_text())["residual_rms_m"] < 0.01
    assert store.load_info(folder).registered
