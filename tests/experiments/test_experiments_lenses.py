"""A film of a simulated board calibrates a camera, which maps and localizers then go by."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from ground_station.calibration.errors import CalibrationError
from ground_station.experiments import lenses, material
from ground_station.experiments.declaration import FlightDeclaration
from ground_station.geometry.camera import THESIS_CAMERA, load_camera
from ground_station.simulator import lighting
from ground_station.simulator.simulate import SimulationSettings, simulate

CAMERA = replace(THESIS_CAMERA, readout_s=0.0)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> partial[SimulationSettings]:
    """Settings of a film of which each picture is of another view, at rest."""
    monkeypatch.setattr(lighting, "_SKY_DIRECTIONS", 8)
    return partial(SimulationSettings, texels_per_m=12.0, duration_s=18.0, rate_hz=1.0)


def test_a_camera_is_found_by_its_film_and_gone_by(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small: partial[SimulationSettings]
) -> None:
    path = tmp_path / "lens.toml"
    monkeypatch.setattr(lenses, "SimulationSettings", small)
    lenses.find(CAMERA, "none", 1, path)
    assert [p.name for p in tmp_path.iterdir()] == ["lens.toml"]
    found = load_camera(path)
    assert found.fx_px == pytest.approx(CAMERA.fx_px, rel=0.004)
    assert found.fy_px == pytest.approx(CAMERA.fy_px, rel=0.004)
    assert (found.cx_px, found.cy_px) == pytest.approx((CAMERA.cx_px, CAMERA.cy_px), abs=1.5)
    assert found != CAMERA
    flight = tmp_path / "flight.mcap"
    simulate(replace(small(out=flight), scene="board", plan="board", duration_s=1.0, camera=CAMERA))
    declared = FlightDeclaration(calibrated=True)
    assert material.flown(declared, flight, tmp_path).camera == CAMERA
    assert material.flown(declared, flight, tmp_path, path).camera == found


def test_a_film_too_short_to_tell_the_camera_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small: partial[SimulationSettings]
) -> None:
    monkeypatch.setattr(lenses, "SimulationSettings", partial(small, duration_s=2.0))
    with pytest.raises(CalibrationError):
        lenses.find(CAMERA, "none", 1, tmp_path / "lens.toml")
    assert not list(tmp_path.iterdir())
