"""The corridor's bays are equal where they should be, and its plan keeps clear of the walls."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from ground_station.simulator import scenes
from ground_station.simulator.corridor import BAY_M, BAYS, LENGTH_M, WIDTH_M
from ground_station.simulator.lighting import surface_albedo
from ground_station.simulator.plans import Reference, plan_named


@pytest.fixture(scope="module")
def corridor():
    return scenes.build("corridor", 10)


def _textures(scene, material, bank):
    chosen = [k for k, s in enumerate(scene.surfaces) if s.material == material]
    return [(scene.surfaces[k], surface_albedo(bank, scene, k)) for k in chosen]


@pytest.mark.parametrize("text", ["SAFETY", "NEWS", "STAFF"])
def test_prints_are_equal_in_every_bay(corridor, text, bank):
    material = "door" if text == "STAFF" else "poster"
    equal = [
        (surface, texture)
        for surface, texture in _textures(corridor, material, bank)
        if surface.options["text"] == text
    ]
    assert len(equal) == BAYS
    for number, (surface, texture) in enumerate(equal):
        assert np.array_equal(texture, equal[0][1])
        step = surface.origin_m - equal[0][0].origin_m
        assert np.allclose(step, [number * BAY_M, 0, 0])


def test_the_paint_differs_from_bay_to_bay(corridor, bank):
    painted = _textures(corridor, "plaster", bank)
    walls = [texture for s, texture in painted if abs(s.u_m[0]) == BAY_M and s.v_m[2]]
    assert len(walls) == 2 * BAYS
    assert all(not np.array_equal(a, b) for a, b in itertools.combinations(walls, 2))


def test_the_plan_flies_the_whole_corridor_and_touches_nothing(corridor):
    plan = plan_named("corridor", corridor, np.random.default_rng(2))
    reference = Reference(plan, 0.3)
    times_s = np.linspace(0, plan.default_duration_s, 400)
    position, yaw = reference.at(times_s)
    assert position[:, 0].min() < 3.2 and position[:, 0].max() > LENGTH_M - 3.2
    assert position[:, 0].min() > 2.0 and position[:, 0].max() < LENGTH_M - 2.0
    assert (position[:, 1] > 0.6).all() and (position[:, 1] < WIDTH_M - 1.0).all()
    assert (position[:, 2] > 1.6).all() and (position[:, 2] < 2.4).all()
    assert np.abs(np.degrees(yaw) - 90).max() < 30  # always the same wall
    step = np.linalg.norm(np.diff(position, axis=0), axis=1) / np.diff(times_s)
    assert np.abs(step - plan.speed_m_s).max() < 0.1 * plan.speed_m_s
