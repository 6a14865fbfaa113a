"""Every scene has room for every plan, and no two are one building."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ground_station.recording.open import open_input
from ground_station.simulator import scenes
from ground_station.simulator.lighting import surface_albedo
from ground_station.simulator.plans import Reference, plan_named
from ground_station.simulator.scene import Scene, SimulatorError
from ground_station.simulator.simulate import simulate
from ground_station.simulator.textures import TextureBank
from tests.simulator.conftest import quick_settings

HULL_M = 0.35
"""Half the blimp's width and what a draught adds."""


def nearest_surface_m(scene: Scene, position_m: np.ndarray) -> float:
    """The least distance from positions (N, 3) to the scene's (rectangular) surfaces."""
    origin, u, v = (
        np.stack([getattr(surface, name) for surface in scene.surfaces])
        for name in ("origin_m", "u_m", "v_m")
    )
    offset = position_m[:, None] - origin
    for edge in (u, v):
        along = np.clip((offset * edge).sum(axis=2) / (edge * edge).sum(axis=1), 0, 1)
        offset = offset - along[..., None] * edge
    return float(np.linalg.norm(offset, axis=2).min())


@pytest.mark.parametrize("plan", ["mapping", "loop", "small-circle", "fast"])
@pytest.mark.parametrize(
    "name", [name for name in scenes.SCENES if name not in ("corridor", "rooms")]
)
def test_every_plan_keeps_clear_of_the_building(name: str, plan: str) -> None:
    scene = scenes.build(name, 10)
    reference = Reference(plan_named(plan, scene, np.random.default_rng(3)), 0.0)
    lap_s = 120.0 if plan == "mapping" else 45.0
    position, _ = reference.at(np.linspace(0, lap_s, 40))
    assert nearest_surface_m(scene, position) > HULL_M


@pytest.mark.parametrize("plan", ["mapping", "loop", "small-circle", "fast", "stills"])
def test_a_halls_plan_that_leaves_the_corridor_is_refused(plan: str) -> None:
    corridor = scenes.build("corridor", 10)
    with pytest.raises(
        SimulatorError, match=rf"'{plan}' does not fit into 'corridor' \(28 x 4 x 3"
    ):
        plan_named(plan, corridor, np.random.default_rng(0))


def test_buildings_share_no_texture() -> None:
    names = [name for name in scenes.SCENES if not name.startswith("atrium-")]
    assert len({scenes.build(name, 10).texture_seed for name in names}) == len(names)


def test_the_office_has_what_a_flight_needs() -> None:
    office = scenes.build("office", 10)
    names = [point.name for point in office.known_points]
    assert len(names) == len(set(names)) >= 12
    assert office.lamps and {f.kind for f in office.footprints} >= {"wall", "furniture"}
    size = np.array(office.size_m)
    for point in office.known_points:
        assert ((np.array(point.position_m) >= 0) & (np.array(point.position_m) <= size)).all()


def test_the_office_can_be_filmed(tmp_path: Path) -> None:
    out = tmp_path / "office.mcap"
    simulate(quick_settings(out, scene="office", light="cloudy", duration_s=0.4))
    frames = [frame.image for frame in open_input(out)]
    assert len(frames) == 2 and all(frame.std() > 20 for frame in frames)


def test_the_aged_hall_is_the_old_one_but_for_its_furniture_and_posters(bank: TextureBank) -> None:
    fresh, moved, posted = (
        scenes.build(name, 10) for name in ("atrium", "atrium-moved", "atrium-moved-posted")
    )
    assert len(fresh.surfaces) == len(moved.surfaces) == len(posted.surfaces)
    other = [
        k
        for k, (a, b) in enumerate(zip(fresh.surfaces, moved.surfaces, strict=True))
        if not np.array_equal(a.origin_m, b.origin_m)
    ]
    assert len(other) > 50
    corners = np.concatenate([moved.surfaces[k].corners() for k in other])
    assert corners[:, 2].max() < 1.7 and (corners[:, :2] > 0).all()
    assert fresh.known_points == moved.known_points == posted.known_points
    k = next(k for k, s in enumerate(fresh.surfaces) if s.material == "poster")
    old, same, new = (surface_albedo(bank, scene, k) for scene in (fresh, moved, posted))
    assert np.array_equal(old, same) and np.abs(old - new).mean() > 0.02
    wall = next(k for k, s in enumerate(fresh.surfaces) if s.material == "brick")
    assert np.array_equal(surface_albedo(bank, fresh, wall), surface_albedo(bank, posted, wall))
