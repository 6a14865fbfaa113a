"""Rolling shutter taken out of a map and its flights, and which frames of a flight are taken."""

from __future__ import annotations

import dataclasses

import numpy as np
from hand_made import by_frame, keyframes_of
from refining import SETTINGS, _along, _seen, _to_and_fro

from ground_station.geometry import poses
from ground_station.map import store
from ground_station.map.refined import Refined
from ground_station.mapping.refinement import shutter
from ground_station.mapping.refinement.chosen import choose_frames, thin
from ground_station.mapping.refinement.refine import refine_map
from ground_station.mapping.settings import RefineSettings


def test_twists_are_those_of_the_motion():
    xi = np.array([0.1, -0.3, 0.2, 0.5, -0.1, 0.9])
    t_s = np.array([0.0, 0.03, 0.07, 0.1, 0.13, 0.17, 0.9])
    wTc = np.array([poses.exp([0, 0, 1, 2, 3, 4]) @ poses.exp(xi * t) for t in t_s])
    found = shutter.twists(np.round(t_s * 1e9).astype(np.int64), wTc, 0.05, 0.2)
    assert np.allclose(found[1:5], xi, atol=1e-6)
    assert np.isnan(found[[0, 5, 6]]).all()  # the last before a gap has no other side


def test_a_moving_frames_pixels_go_where_a_global_shutter_saw_them(world):
    rng = np.random.default_rng(0)
    camera = dataclasses.replace(world.map.info.camera, readout_s=0.02)
    t_s, speed = 1.0, 3.0
    wTc = _along(np.array([t_s]), speed)[0]
    index, rolling = _seen(world.points, wTc, camera, rng, 0.0, speed, t_s)
    around = np.array([t_s - 0.02, t_s, t_s + 0.02])
    twist = shutter.twists((around * 1e9).astype(np.int64), _along(around, speed), 0.03, 0.1)[1]
    local = poses.transform(poses.inverse(wTc), world.points[index])
    shift = shutter.shift_px(
        local, np.tile(twist, (len(local), 1)), shutter.row_times_s(rolling[:, 1], camera), camera
    )
    exact = camera.undistort_to_pinhole(camera.project(local))
    off = np.linalg.norm(camera.undistort_to_pinhole(rolling) - exact, axis=1)
    corrected = np.linalg.norm(camera.undistort_to_pinhole(rolling) - shift - exact, axis=1)
    assert off.max() > 1.0 and corrected.max() < 0.05


def test_a_maps_own_shutter_is_undone_once_and_not_where_there_was_none(world):
    """Keyframes taken at 3 m/s, 40 ms apart, with 20 ms of readout; without a flight."""
    rng = np.random.default_rng(2)
    camera = dataclasses.replace(world.map.info.camera, readout_s=0.02)
    t_s, speed = 0.04 * np.arange(16), 3.0
    wTc = _to_and_fro(t_s, speed)
    rows = [
        _seen(world.points, T, camera, rng, 0.1, speed, t, _to_and_fro)
        for T, t in zip(wTc, t_s.tolist(), strict=True)
    ]
    keyframes = keyframes_of(wTc, 40_000_000, **by_frame(rows))
    info = dataclasses.replace(world.map.info, camera=camera)
    store.save_tables(world.folder, dataclasses.replace(world.map, info=info, keyframes=keyframes))
    first, result = refine_map(world.folder, [], SETTINGS)
    shutter_report = result.report["rolling_shutter"]
    assert shutter_report["undone"] and shutter_report["keyframes"] == 14
    assert shutter_report["sigma_without_px"] < 0.7 * shutter_report["sigma_with_px"]
    assert Refined.of(first).pixels_at == "frame"
    second, again = refine_map(world.folder, [], SETTINGS)
    assert again.report["rolling_shutter"] == {"keyframes": 0, "undone": True}
    assert np.abs(second.keyframes.pixel_px - first.keyframes.pixel_px).max() < 1e-3
    # Observations that a global shutter took are not spoilt by a readout that the camera file
    # claims.
    rows = [_seen(world.points, T, camera, rng, 0.1) for T in wTc]
    keyframes = keyframes_of(wTc, 40_000_000, **by_frame(rows))
    store.save_tables(world.folder, dataclasses.replace(world.map, info=info, keyframes=keyframes))
    _, result = refine_map(world.folder, [], SETTINGS)
    assert not result.report["rolling_shutter"]["undone"]


def test_frames_are_thinned_by_what_changed(world):
    flight, settings = world.flight(60, rate_hz=30.0), RefineSettings()
    chosen = choose_frames(flight, world.map, settings)
    assert 2 <= len(chosen) <= 8
    assert np.diff(chosen.time_ns).min() >= settings.min_interval_s * 1e9
    assert chosen.left["view unchanged"] == 60 - len(chosen) - chosen.left["no velocity"]
    still = dataclasses.replace(flight, wTc=np.tile(flight.wTc[:1], (60, 1, 1)))
    assert len(choose_frames(still, world.map, dataclasses.replace(settings, max_misfit_px=99))) < 2
    fewer = thin([chosen, chosen], 4)
    assert sum(map(len, fewer)) <= 4
    assert all(set(f.frame.tolist()) == set(range(len(f))) for f in fewer)


def test_a_frame_too_fast_for_its_readout_is_left_out(world):
    camera = dataclasses.replace(world.map.info.camera, readout_s=0.02)
    flight = dataclasses.replace(world.flight(30, rate_hz=30.0), camera=camera)
    slow = choose_frames(flight, world.map, RefineSettings())
    hurried = dataclasses.replace(flight, time_ns=flight.time_ns // 60)
    fast = choose_frames(hurried, world.map, RefineSettings(min_interval_s=0.0))
    assert len(slow) >= 2 and len(fast) == 0 and fast.left["too fast"] > 20
