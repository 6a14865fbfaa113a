"""A person's camera: stills on a grid, a walk through rooms, a calibration that is off."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from quick_flight import asked_for, quick_settings

from ground_station.arrays import F64
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.recording.flight import camera_of
from ground_station.simulator import scenes
from ground_station.simulator.hall import PANEL_M, ROW_M
from ground_station.simulator.imaging import covering_pinhole
from ground_station.simulator.lighting import surface_albedo
from ground_station.simulator.plans import HEADSET_CAMERA, WIDE_CAMERA
from ground_station.simulator.simulate import (
    SimulatedFlight,
    SimulationSettings,
    prepare_flight,
    simulate,
)
from ground_station.simulator.textures import TextureBank
from pi_firmware.wire.recording import FRAME_INFO_TOPIC, RecordingReader
from tests.simulator.test_simulator_scenes import nearest_surface_m

SEEDS = range(6)


def flight_of(plan: str, seed: int, **changes: object) -> SimulatedFlight:
    scene = {"stills": "hall", "headset": "rooms"}[plan]
    values: dict[str, object] = {"scene": scene, "plan": plan, "seed": seed, "texels_per_m": 10.0}
    return prepare_flight(SimulationSettings(out=Path("f.mcap"), **(values | changes)))  # type: ignore[arg-type]


def true_poses(flight: SimulatedFlight) -> F64:
    return flight.motion.wTc(flight.times_s)


def turns_deg(wTc: F64) -> F64:
    pairs = itertools.pairwise(wTc[:, :3, :3])
    return np.degrees([float(poses.rotation_angle(a.T @ b)) for a, b in pairs])


@pytest.mark.parametrize("seed", range(2))
def test_stills_are_eight_headings_at_each_of_twelve_places(seed: int) -> None:
    flight = flight_of("stills", seed)
    wTc = true_poses(flight)
    assert len(wTc) == 96
    step = wTc[:, :2, 3] - wTc[:, :2, 3].min(axis=0)
    cells = np.rint(step / [3.8, 1.8]).astype(int)
    assert np.abs(step - cells * [3.8, 1.8]).max() < 0.4  # held by hand
    axis = wTc[:, :3, 2]
    heading = np.degrees(np.arctan2(axis[:, 1], axis[:, 0]))
    for cell in itertools.product(range(4), range(3)):
        mine = np.sort(heading[(cells == cell).all(axis=1)])
        assert len(mine) == 8
        assert np.abs(np.diff(mine) - 45).max() < 15
    assert nearest_surface_m(flight.scene, wTc[:, :3, 3]) > 1.0


def test_the_order_of_stills_means_nothing_and_is_the_seeds() -> None:
    first, again, other = (true_poses(flight_of("stills", seed)) for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    near = [np.linalg.norm(np.diff(T[:, :2, 3], axis=0), axis=1) < 1 for T in (first, other)]
    assert all(share.mean() < 0.25 for share in near)  # by chance 7 of 95 stay at their place
    assert np.linalg.norm(first[:, :3, 3] - other[:, :3, 3], axis=1).max() > 3


def test_a_still_is_held_while_it_is_taken() -> None:
    flight = flight_of("stills", 3)
    times = flight.times_s[[0, 1, 50, 95]]
    for offset in (-0.1, 0.1):
        assert np.array_equal(flight.motion.wTc(times), flight.motion.wTc(times + offset))
    speed, turn = flight.motion.speed(flight.times_s)
    assert not speed.any() and not turn.any()


def test_all_stills_are_taken_at_any_rate_and_none_twice() -> None:
    assert len(flight_of("stills", 0, rate_hz=2.0).times_s) == 96
    assert len(flight_of("stills", 0, duration_s=1000.0).times_s) == 96
    assert len(flight_of("stills", 0, duration_s=10.0).times_s) == 5


def test_the_wide_lens_sees_a_hundred_degrees_and_is_rendered_whole() -> None:
    c = WIDE_CAMERA
    sides = c.undistort([[0.0, c.cy_px], [c.width_px - 1.0, c.cy_px]])[:, 0]
    assert np.degrees(np.ptp(np.arctan(sides))) == pytest.approx(100, abs=0.5)
    corners = [[0.0, 0.0], [639.0, 0.0], [0.0, 479.0], [639.0, 479.0]]
    rays = c.undistort(corners)
    assert np.abs(c.distort(rays) - corners).max() < 1e-6  # it does not fold back before
    pinhole = covering_pinhole(c, 1.0)
    pixels = rays * pinhole.focal_px + pinhole.centre_px
    assert (pixels > 0).all() and (pixels < [pinhole.width_px - 1, pinhole.height_px - 1]).all()


def test_the_halls_panels_are_two_prints_and_its_doors_and_posters_all_differ(
    bank: TextureBank,
) -> None:
    hall = scenes.build("hall", 10)
    walls = [k for k, s in enumerate(hall.surfaces) if s.size_m == pytest.approx((PANEL_M, ROW_M))]
    assert len(walls) == 160
    plates = {surface_albedo(bank, hall, k).tobytes() for k in walls}
    assert len(plates) == 2
    for material, count in (("door", 6), ("poster", 10)):
        own = [k for k, s in enumerate(hall.surfaces) if s.material == material]
        assert len({surface_albedo(bank, hall, k).tobytes() for k in own}) == count


@pytest.mark.parametrize("seed", range(3))
def test_a_headset_walks_thirty_metres_and_touches_nothing(seed: int) -> None:
    flight = flight_of("headset", seed)
    wTc = true_poses(flight)
    step = np.linalg.norm(np.diff(wTc[:, :3, 3], axis=0), axis=1)
    assert 150 <= len(wTc) <= 200 and flight.rate_hz == 5
    assert np.median(step) == pytest.approx(0.16, abs=0.01)
    assert step.sum() == pytest.approx(30, abs=1)
    assert min(nearest_surface_m(flight.scene, p[None]) for p in wTc[:, :3, 3]) > 0.3
    turned = turns_deg(wTc)
    assert turned.mean() == pytest.approx(8, abs=1.5)
    assert turned.max() < 45
    axis = wTc[:, :3, 2]
    assert np.ptp(np.degrees(np.arcsin(axis[:, 2]))) > 20  # it nods


def test_a_headset_goes_through_rooms_and_comes_back_for_some_seeds_only() -> None:
    gaps, rooms_seen = [], []
    for seed in SEEDS:
        path = true_poses(flight_of("headset", seed))[:, :2, 3]
        gaps.append(float(np.linalg.norm(path[-1] - path[0])))
        x, y = path.T
        rooms = [(y > 5.5) & (x < 4.5), (y > 5.5) & (x > 4.7) & (x < 8.5), (y > 5.5) & (x > 8.7),
                 (y < 3.9) & (x < 6.3), (y < 3.9) & (x > 6.5)]  # fmt: skip
        rooms_seen.append(sum(bool(inside.any()) for inside in rooms))
    assert min(rooms_seen) >= 3
    assert min(gaps) < 3.5 and max(gaps) > 5


def test_a_calibration_off_by_a_share_is_carried_and_the_true_lens_noted(tmp_path: Path) -> None:
    out, right = tmp_path / "wrong.mcap", tmp_path / "right.mcap"
    quick = {"scene": "rooms", "plan": "headset", "duration_s": 0.2, "light": "cloudy"}
    simulate(quick_settings(out, lens_error=0.01, **quick))
    simulate(quick_settings(right, **quick))
    reader = RecordingReader(out)
    carried = camera_of(reader)
    assert carried is not None
    assert carried.fx_px == pytest.approx(1.01 * HEADSET_CAMERA.fx_px)
    assert carried.fy_px == pytest.approx(1.01 * HEADSET_CAMERA.fy_px)
    assert (carried.cx_px, carried.k1) == (HEADSET_CAMERA.cx_px, HEADSET_CAMERA.k1)
    assert float(reader.metadata_table("true_camera")["fx_px"]) == HEADSET_CAMERA.fx_px
    assert reader.metadata_table("simulation")["lens_error"] == "0.01"
    # The pictures are the true lens's all the same.
    other = RecordingReader(right)
    assert [s.data for s in reader.video()] == [s.data for s in other.video()]
    assert not other.metadata_table("true_camera")
    assert camera_of(other) == HEADSET_CAMERA


def test_each_still_is_exposed_for_what_it_shows(tmp_path: Path) -> None:
    out = tmp_path / "stills.mcap"
    settings = quick_settings(out, scene="hall", plan="stills", duration_s=4.0, rate_hz=None)
    simulate(settings)
    stamps, info = zip(*RecordingReader(out).json(FRAME_INFO_TOPIC), strict=True)
    assert np.diff(stamps).tolist() == [2_000_000_000]
    assert prepare_flight(settings).camera == WIDE_CAMERA
    assert len({i["exposure_s"] for i in info}) > 1


def test_the_command_takes_a_lens_from_a_file(tmp_path: Path) -> None:
    lens = tmp_path / "lens.toml"
    lens.write_text("width_px = 320\nheight_px = 240\nfx_px = 200.0\nfy_px = 200.0\n"
                    "cx_px = 159.5\ncy_px = 119.5\nk1 = -0.1\n")  # fmt: skip
    settings = asked_for("--camera", str(lens), "--lens-error", "-0.02")
    assert settings.camera == Camera(320, 240, 200.0, 200.0, 159.5, 119.5, k1=-0.1)
    assert prepare_flight(settings).carried.fx_px == pytest.approx(196.0)
    assert asked_for().camera is None
