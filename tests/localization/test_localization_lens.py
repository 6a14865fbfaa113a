"""The lens of a flight against its map's: taken for the same, put right, or reckoned with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from synthetic import CAMERA, FakeExtractor, preset_with

from ground_station.experiments.disturbances.scale import Scale
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.localization.lens import against_map, considered
from ground_station.localization.localizer import Localizer
from ground_station.localization.settings import load_preset
from ground_station.map.store import Landmarks, MapInfo
from tests.localization.conftest import Room

NAMES = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3")


def longer(camera: Camera, share: float) -> Camera:
    return replace(camera, fx_px=camera.fx_px * (1 + share), fy_px=camera.fy_px * (1 + share))


def map_info(state: str, given: Camera) -> MapInfo:
    lens: dict[str, Any] = {"state": state, "given": {n: getattr(given, n) for n in NAMES}}
    return MapInfo("synthetic", "0" * 64, 64, CAMERA, built={"lens": lens})


def test_a_lens_that_the_maps_pictures_denied_is_put_right() -> None:
    given = replace(longer(CAMERA, 0.05), k1=0.0)
    flight = replace(given, readout_s=0.02)
    camera, is_maps = against_map(map_info("found", given), flight)
    assert is_maps and camera == replace(CAMERA, readout_s=0.02)
    for other, info in (
        (longer(given, 0.001), map_info("found", given)),  # another day's
        (flight, map_info("open", given)),
        (Scale(0.5).camera(flight), map_info("found", given)),
        (flight, replace(map_info("found", given), built={})),
    ):
        assert against_map(info, other) == (other, False)


def test_the_localizer_sees_by_the_lens_that_was_found(
    room: Room, extractor: FakeExtractor
) -> None:
    given = longer(CAMERA, 0.05)
    denied = replace(room.map, info=replace(room.map.info, built=map_info("found", given).built))
    assert Localizer(denied, given, extractor, load_preset("default")).camera == CAMERA
    assert Localizer(room.map, given, extractor, load_preset("default")).camera == given


def test_the_maps_own_lens_is_known_at_any_size() -> None:
    info = map_info("given", CAMERA)
    for flight in (CAMERA, replace(CAMERA, readout_s=0.01), Scale(0.5).camera(CAMERA)):
        assert against_map(info, flight) == (flight, True)
    assert not against_map(info, longer(CAMERA, 1e-3))[1]


def test_a_bend_that_no_trajectory_measured_is_reckoned_with(room: Room) -> None:
    bent = replace(room.map.landmarks, by_focal_m=np.ones((len(room.map.landmarks), 3), np.float32))
    by_points = {"method": "observations", "point_sigma_m": 0.01}

    def of(registration: dict[str, Any], landmarks: Landmarks, is_maps: bool) -> list[list[float]]:
        info = replace(room.map.info, registration=registration)
        told = replace(room.map, info=info, landmarks=landmarks)
        return np.round(considered(told, is_maps, 0.002) * 1e6, 9).tolist()

    assert of(by_points, bent, True) == [[2, 2], [2, 2]]  # one lens: the same error
    assert of(by_points, bent, False) == [[4, 0], [0, 2]]
    for registration, landmarks in (
        ({"method": "trajectory", "sigma_deg": 0.1}, bent),
        (by_points, room.map.landmarks),  # a map of before
    ):
        assert of(registration, landmarks, True) == [[0, 0], [0, 0]]
        assert of(registration, landmarks, False) == [[4, 0], [0, 0]]


def errors_of(room: Room, extractor: FakeExtractor) -> Callable[[float, Camera], float]:
    times, wTc = room.path(30)
    seen = [room.features(T) for T in wTc]

    def off(focal: float, camera: Camera) -> float:
        """The mean squared error over the covariance, of 6 where both fit."""
        settings = preset_with(covariance={"focal": focal})
        localizer = Localizer(room.map, camera, extractor, settings)
        localizer.set_initial_pose(wTc[0], int(times[0]))
        found = []
        for time_ns, true, features in zip(times, wTc, seen, strict=True):
            estimate = localizer.process_features(int(time_ns), features)
            assert estimate.wTc is not None and estimate.covariance is not None
            error = poses.log(poses.inverse(estimate.wTc) @ true)
            found.append(float(error @ np.linalg.solve(estimate.covariance, error)))
        return float(np.mean(found[5:]))

    return off


@pytest.mark.parametrize("share", [-0.005, 0.005])
def test_another_cameras_focal_length_is_reckoned_with(
    room: Room, extractor: FakeExtractor, share: float
) -> None:
    off, wrong = errors_of(room, extractor), longer(room.camera, share)
    assert off(0.0, wrong) > 60
    assert off(0.005, wrong) < 20


def test_the_maps_own_focal_length_is_not_doubted(room: Room, extractor: FakeExtractor) -> None:
    off = errors_of(room, extractor)
    assert off(0.005, room.camera) == off(0.0, room.camera) < 12
