"""What `blimp map info` says of a map whose figures are known."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hand_made import run
from rooms_map import SIGMA_M, two_rooms

from ground_station.inspection import command
from ground_station.map import store
from ground_station.map.summary import describe, figures


def test_figures_are_those_of_the_map():
    map_ = two_rooms()
    found = figures(map_)
    assert np.array_equal(found["track"], map_.landmarks.observations)
    assert found["error_px"].max() < 1e-3  # its pixels are where its landmarks project
    assert np.allclose(found["landmark_sigma"], SIGMA_M * np.sqrt(3))
    assert found["in_keyframe"].sum() == len(map_.keyframes.landmark)
    seen = np.flatnonzero(map_.landmarks.observations > 1)
    rays = map_.keyframes.wTc[:9, :3, 3] - map_.landmarks.position_m[seen[0]]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    widest = np.degrees(np.arccos((rays @ rays.T).min()))
    assert 0 < found["angle_deg"][seen[0]] <= widest + 1e-6


def test_what_is_said_has_percentiles_and_extent():
    map_ = two_rooms()
    document = describe(map_)
    assert document["track"]["p50"] == np.median(map_.landmarks.observations)
    assert document["extent"][0] == pytest.approx(6.0) and document["extent"][2] < 3.0
    steps = np.linalg.norm(np.diff(map_.keyframes.wTc[:, :3, 3], axis=0), axis=1)
    assert document["keyframes_path"] == pytest.approx(steps.sum(), rel=1e-3)
    assert 0 < document["covered_area"] < 36


def test_a_map_without_observations_is_described():
    map_ = two_rooms(5)
    for table in (map_.landmarks, map_.keyframes):
        for name, value in vars(table).items():
            setattr(table, name, value[:0] if name != "offset" else value[:1])
    document = describe(map_)
    assert document["landmarks"] == 0 and "track" not in document


def test_info_says_where_one_gets_lost_when_asked(tmp_path, capsys):
    folder = tmp_path / "rooms"
    folder.mkdir()
    store.save_tables(folder, two_rooms())
    written = tmp_path / "info.json"
    assert run(command, folder, "--localizability", "--json", written) == 0
    document = json.loads(written.read_text())
    assert document["localizability"]["places_lost_in_some_heading"] == 1.0
    assert "localizability" in capsys.readouterr().out
    run(command, folder)
    assert "localizability" not in capsys.readouterr().out
