"""The blimp floats, drifts, swings and follows; the runner runs."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from ground_station.simulator import scenes
from ground_station.simulator.dynamics import GRAVITY_M_S2, Blimp, BlimpState, fly, step
from ground_station.simulator.handheld import carry
from ground_station.simulator.plans import Plan, Reference, plan_named
from ground_station.simulator.scene import Scene

DT_S = 1 / 200


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scenes.build("atrium", 10)


def at_rest() -> BlimpState:
    return BlimpState([0.0] * 3, [0.0] * 3, [0.0] * 3, [0.0] * 3)


def plan_of(name: str, scene: Scene, seed: int = 0) -> Plan:
    return plan_named(name, scene, np.random.default_rng(seed))


def test_the_blimp_is_neutral_within_two_grams() -> None:
    assert abs(Blimp.of_build().net_lift_N) < 0.002 * GRAVITY_M_S2


def test_left_alone_in_still_air_it_hovers() -> None:
    blimp, state = Blimp.of_build(), at_rest()
    for _ in range(round(5 / DT_S)):
        step(blimp, state, (0.0, 0.0, 0.0), 0.0, (0.0, 0.0, 0.0), DT_S)
    assert np.hypot(*state.position_m[:2]) == 0
    assert abs(state.position_m[2]) < 0.5 * abs(blimp.net_lift_N) / blimp.inertial_mass_kg[2] * 26


@pytest.mark.parametrize("axis", [0, 1])
def test_its_terminal_speed_is_where_drag_equals_thrust(axis: int) -> None:
    blimp, state = Blimp.of_build(), at_rest()
    thrust = [0.0, 0.0, 0.0]
    thrust[axis] = 0.1
    for _ in range(round(60 / DT_S)):
        step(blimp, state, (thrust[0], thrust[1], 0.0), 0.0, (0.0, 0.0, 0.0), DT_S)
    frontal = math.pi * blimp.semi_width_m**2
    side = math.pi * blimp.semi_width_m * blimp.semi_length_m
    area, drag = ((frontal, blimp.drag_axial), (side, blimp.drag_lateral))[axis]
    assert state.velocity_m_s[axis] == pytest.approx(
        math.sqrt(2 * 0.1 / (1.204 * drag * area)), rel=0.01
    )


def test_a_draught_carries_it_to_the_airs_speed() -> None:
    blimp, state = Blimp.of_build(), at_rest()
    for _ in range(round(60 / DT_S)):
        step(blimp, state, (0.0, 0.0, 0.0), 0.0, (0.0, 0.3, 0.0), DT_S)
    assert state.velocity_m_s[1] == pytest.approx(0.3, rel=0.1)


def test_it_swings_at_the_frequency_of_its_pendulum() -> None:
    blimp, state = replace(Blimp.of_build(), swing_damping=0.0), at_rest()
    state.angles_rad[1] = 0.1
    angles = []
    for _ in range(round(30 / DT_S)):
        step(blimp, state, (0.0, 0.0, 0.0), 0.0, (0.0, 0.0, 0.0), DT_S)
        angles.append(state.angles_rad[1])
    crossings = np.flatnonzero(np.diff(np.sign(angles)))
    period_s = 2 * np.diff(crossings).mean() * DT_S
    assert period_s == pytest.approx(2 * math.pi / blimp.swing_rate_rad_s[0], rel=0.01)
    assert 1 < period_s < 6


@pytest.mark.parametrize("name", ["mapping", "loop", "small-circle"])
def test_the_blimp_flies_its_plan_slowly_and_clear_of_everything(name: str, scene: Scene) -> None:
    plan = plan_of(name, scene)
    reference = Reference(plan, 0.3)
    motion = fly(reference, plan.default_duration_s, np.random.default_rng(1))
    t = np.arange(0, plan.default_duration_s, 0.1)
    camera = motion.wTc(t)[:, :3, 3]
    want, _ = reference.at(t)
    assert np.linalg.norm(camera - want, axis=1).max() < 1.0
    speed, turn = motion.speed(t)
    assert 0.4 < speed.mean() < 0.8
    assert np.degrees(turn.max()) < 45
    assert camera[:, 2].min() > 1.0
    assert camera[:, 2].max() < 5.0
    for f in scene.footprints:
        if f.kind in ("pillar", "wall", "stairs"):
            x0, y0, x1, y1 = f.bounds_m
            gap = np.maximum(0, np.maximum([x0, y0] - camera[:, :2], camera[:, :2] - [x1, y1]))
            assert np.linalg.norm(gap, axis=1).min() > 0.5, f


def test_the_fast_plan_really_reaches_4_metres_and_45_degrees_a_second(scene: Scene) -> None:
    plan = plan_of("fast", scene)
    motion = carry(Reference(plan, 0.1, 3.0), plan.default_duration_s, np.random.default_rng(1))
    speed, turn = motion.speed(np.arange(5, plan.default_duration_s, 0.05))
    assert np.median(speed) > 3.8
    assert np.degrees(np.median(turn)) > 45
    start, _ = motion.speed([0.0])
    assert start[0] < 0.5


def test_a_seed_gives_its_flight_again_and_another_seed_another(scene: Scene) -> None:
    def positions(seed: int) -> np.ndarray:
        rng = np.random.default_rng(seed)
        plan = plan_named("loop", scene, rng)
        return fly(Reference(plan, 0.0), 5.0, rng).wTc(np.arange(0, 5, 0.5))

    assert np.array_equal(positions(3), positions(3))
    assert np.abs(positions(3) - positions(4)).max() > 0.02
