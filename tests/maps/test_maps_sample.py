"""The sample that ships keeps what its page promises."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from ground_station.geometry.camera import THESIS_CAMERA
from ground_station.geometry.poses import rotation_angle
from ground_station.localization.extraction import extractor_for
from ground_station.localization.settings import load_preset
from ground_station.map import store
from ground_station.map.floorplan import load_floorplan
from ground_station.map.uncertainty import accuracy
from ground_station.mapping.registration.observations import read_pairs
from ground_station.mapping.settings import load_settings
from ground_station.recording.flight import camera_of, trajectory_of
from pi_firmware.wire.recording import RecordingReader

SAMPLE = Path(__file__).parents[2] / "maps" / "atrium"
MB = 1_000_000


def test_the_files_stay_small() -> None:
    recordings = [(SAMPLE / name).stat().st_size for name in ("mapping.mcap", "flight.mcap")]
    assert max(recordings) < 6 * MB and sum(recordings) <= 12 * MB
    map_files = [*SAMPLE.glob("*.safetensors"), SAMPLE / "map.toml", *SAMPLE.glob("sparse/*")]
    assert sum(path.stat().st_size for path in map_files) < 6 * MB


@pytest.mark.parametrize("name", ["mapping.mcap", "flight.mcap"])
def test_a_flight_is_whole_and_says_where_it_comes_from(name: str) -> None:
    reader = RecordingReader(SAMPLE / name)
    topics = reader.topics()
    assert not reader.cut
    assert topics["/camera/video"] == topics["/truth/pose"] == topics["/camera/frame"]
    assert camera_of(reader) == THESIS_CAMERA
    assert reader.metadata_table("simulation")["seed"].isdigit()


def test_the_flights_take_different_paths() -> None:
    mapping = trajectory_of(SAMPLE / "mapping.mcap")
    flight = trajectory_of(SAMPLE / "flight.mcap")
    assert (flight.time_ns[-1] - flight.time_ns[0]) / 1e9 >= 30
    assert np.median(np.diff(flight.time_ns)) == pytest.approx(1e9 / 30, abs=1e6)
    gaps = np.linalg.norm(flight.position_m[::30, None] - mapping.position_m[None], axis=2)
    assert np.median(gaps.min(axis=1)) > 0.1


def test_the_map_is_registered_to_the_building() -> None:
    """Judged by the mapping flight's true poses, which neither the build nor PAIRS.csv held."""
    map_, truth = store.load(SAMPLE), trajectory_of(SAMPLE / "mapping.mcap")
    assert map_.info.registered and map_.info.units == "m"
    at = [truth.nearest(int(t)) for t in map_.keyframes.time_ns]
    assert (truth.time_ns[at] == map_.keyframes.time_ns).all()
    assert len(map_.keyframes) == len(truth)
    off = np.linalg.norm(map_.keyframes.wTc[:, :3, 3] - truth.position_m[at], axis=1)
    assert np.sqrt(np.mean(off**2)) < 0.02 and off.max() < 0.10
    known = accuracy(map_.info).registration
    assert known is not None  # or poses in it would pass for surer than they are
    assert np.median(off / known.sigma_m(truth.position_m[at])) < 2
    turn = map_.keyframes.wTc[:, :3, :3] @ np.swapaxes(truth.wTc[at][:, :3, :3], 1, 2)
    assert np.degrees(rotation_angle(turn)).max() < 0.5


def test_the_map_is_of_the_features_and_settings_that_are_used() -> None:
    info = store.load_info(SAMPLE)
    used = extractor_for(info, load_preset("thesis").features)
    store.check_features(info, used.name, used.sha256)
    settings = load_settings(SAMPLE / "mapping.toml")
    assert info.built["settings"]["sfm"]["min_track"] == settings.sfm.min_track == 4


def test_colmaps_own_reader_opens_the_model() -> None:
    map_ = store.load(SAMPLE)
    model = pycolmap.Reconstruction(SAMPLE / "sparse")
    assert model.num_reg_images() == len(map_.keyframes)
    points = {key: point.xyz for key, point in model.points3D.items()}
    assert set(points) == set(map_.landmarks.id.tolist())
    ours = np.array([points[key] for key in map_.landmarks.id.tolist()])
    np.testing.assert_allclose(ours, map_.landmarks.position_m, atol=1e-9)


def test_the_observations_span_the_hall() -> None:
    """Enough points, far apart in all three directions, each seen from two places or more."""
    observations = read_pairs(SAMPLE / "PAIRS.csv")
    assert len(observations.points) >= 10
    assert (np.ptp(observations.world_m, axis=0) > [4, 4, 2]).all()
    assert (np.bincount(observations.point) >= 2).all()


def test_the_floor_plan_covers_the_flight() -> None:
    plan = load_floorplan(SAMPLE / "floorplan.yaml")
    assert plan.origin[2] == 0
    flight = trajectory_of(SAMPLE / "flight.mcap").position_m[:, :2]
    low = np.array(plan.origin[:2])
    assert (flight > low).all() and (flight < low + plan.size_m).all()
