"""What faults befall: a numbered flight, and a small map for programs that must refuse it."""

import sys
from pathlib import Path

import numpy as np
import pytest

from ground_station.features import extractors
from ground_station.geometry.camera import THESIS_CAMERA
from ground_station.map import store

sys.path.insert(0, str(Path(__file__).parents[1] / "stream"))  # for numbered_flight


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A numbered flight to fly in a loop."""
    from flight import ROUND
    from numbered_flight import write_flight

    return write_flight(tmp_path_factory.mktemp("flight") / "flight.mcap", ROUND)


@pytest.fixture
def small_map(tmp_path: Path) -> Path:
    draw = np.random.default_rng(7)
    m, rootsift = 50, extractors.create("rootsift")
    landmarks = store.Landmarks(
        id=np.arange(1, m + 1),
        position_m=draw.uniform(-3, 3, (m, 3)),
        covariance_m2=np.tile(np.eye(3, dtype=np.float32) * 1e-4, (m, 1, 1)),
        descriptor=draw.uniform(0, 1, (m, 128)).astype(np.float32),
        spread=np.full(m, 0.1, np.float32),
        view_direction=np.tile(np.array([[0, 0, -1]], np.float32), (m, 1)),
        view_cos=np.full(m, 0.5, np.float32),
        distance_m=np.tile(np.array([[1, 9]], np.float32), (m, 1)),
        observations=np.full(m, 3, np.int32),
    )
    keyframes = store.Keyframes(
        names=["frame-000000"],
        time_ns=np.zeros(1, np.int64),
        wTc=np.eye(4)[None],
        offset=np.array([0, m]),
        landmark=np.arange(m, dtype=np.int32),
        pixel_px=draw.uniform(0, 480, (m, 2)).astype(np.float32),
    )
    info = store.MapInfo(
        features=rootsift.name,
        features_sha256=rootsift.sha256,
        dimension=rootsift.dimension,
        camera=THESIS_CAMERA,
        name="small",
        frame="world",
        units="m",
    )
    folder = tmp_path / "small"
    folder.mkdir()
    store.save_tables(folder, store.Map(info, landmarks, keyframes))
    return folder
