"""Every scene has room for every plan, and no two are one building."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from quick_flight import quick_settings

from ground_station.recording.open import open_input
from ground_station.simulator import scenes
from ground_station.simulator.building import SceneBuilder
from ground_station.simulator.lighting import light_named, lit_textures, looking, surface_albedo
from ground_station.simulator.plans import Reference, plan_named
from ground_station.simulator.rendering import Pinhole, SceneRenderer
from ground_station.simulator.scene import Scene, SimulatorError
from ground_station.simulator.simulate import simulate
from ground_station.simulator.textures import TextureBank

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
    "name", [name for name in scenes.SCENES if name not in ("corridor", "rooms", "board")]
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
    names = [name for name in scenes.SCENES if not name.startswith(("atrium-", "hall-"))]
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


def test_of_the_furniture_only_the_share_that_is_asked_for_has_been_moved() -> None:
    fresh = scenes.build("atrium", 10)

    def moved(name: str) -> set[int]:
        pairs = enumerate(zip(fresh.surfaces, scenes.build(name, 10).surfaces, strict=True))
        return {k for k, (a, b) in pairs if not np.array_equal(a.origin_m, b.origin_m)}

    few, half, all_ = (moved(f"atrium-moved{share}") for share in ("-25", "-50", ""))
    assert few < half < all_
    assert 0.1 < len(few) / len(all_) < 0.4 < len(half) / len(all_) < 0.6


@pytest.mark.parametrize("alike", [True, False])
def test_a_floor_above_that_is_alike_has_the_same_plates_and_nothing_else_is_equal(
    bank: TextureBank, alike: bool
) -> None:
    below, above = (scenes.build("hall" + more, 10) for more in ("", "-above" + "-alike" * alike))
    equal = {True: 0, False: 0}
    for k, a in enumerate(below.surfaces):
        if a.material in ("sky", "metal", "foliage") or a.options.get("rgb") == (0.13, 0.13, 0.14):
            continue
        same = np.array_equal(surface_albedo(bank, below, k), surface_albedo(bank, above, k))
        assert same == (alike and "print" in a.options), a
        equal[same] += 1
    assert equal[False] > 150 and (equal[True] > 250 if alike else equal[False] > 400)


def test_dark_glass_shows_what_a_camera_behind_it_would_see_mirrored() -> None:
    builder = SceneBuilder(40)
    for x in (-2.0, 0.4):  # two prints a metre or two before the pane
        builder.rectangle(
            [x + 1.6, -1 - x / 4, 0], [-1.6, 0.2, 0.1], [0, 0, 1.7], "poster", text="GLASS"
        )
    count = len(builder.surfaces)
    pane = builder.rectangle([2, 1, 0], [-4, 0, 0], [0, 0, 2], "metal")
    assert np.allclose(pane.normal, [0, 1, 0])  # its back is to what it shows
    builder.mirrors(pane, 0.25)
    lit = lit_textures(builder.scene("glass", (4, 2, 2), 7), light_named("noon"))
    pinhole = Pinhole(320, 240, 200)
    eye = looking(np.array([0.1, -1.0, 0.0]), np.array([0.2, 0.6, 0.9]), 0.0)
    mirrored = np.diag([1.0, -1.0, 1.0, 1.0]) @ eye @ np.diag([-1.0, 1.0, 1.0, 1.0])
    mirrored[1, 3] += 2.0  # in the plane y = 1
    pictures = []
    for pose, some in ((eye, slice(count, None)), (mirrored, slice(count))):
        surfaces = builder.surfaces[some]
        with SceneRenderer(surfaces, lit.textures[some], (320, 240)) as renderer:
            pictures.append(renderer.image_and_depth(pose, pinhole))
    (seen, away_m), (true, far_m) = pictures
    assert np.isfinite(far_m).mean() > 0.2
    assert np.array_equal(np.isfinite(away_m), np.isfinite(far_m[:, ::-1]))
    both = np.isfinite(away_m)
    assert np.abs(away_m[both] - far_m[:, ::-1][both]).max() < 0.01
    off = seen.astype(float) - 0.5 * true[:, ::-1]  # codes go with the root of the light
    assert np.abs(off).mean() < 2.0 and seen[both].std() > 5.0


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


def test_light_goes_through_a_day_and_lamps_are_lit_when_it_is_dim() -> None:
    night, dawn, noon, dusk = (light_named(f"{hour}h") for hour in (1, 6, 12, 18))
    assert noon.sun_elevation_deg == pytest.approx(60.0)
    assert noon.sun_azimuth_deg == pytest.approx(-90.0)  # the south
    assert abs(dawn.sun_azimuth_deg) < 15 and abs(abs(dusk.sun_azimuth_deg) - 180) < 15
    assert night.sun_level == night.sky_level == 0.0 < night.lamp_level == dusk.lamp_level
    assert noon.lamp_level == 0.0 and 0 < dusk.sun_level < 0.5 * noon.sun_level
    assert dusk.sun_rgb[0] / dusk.sun_rgb[2] > 2 * noon.sun_rgb[0] / noon.sun_rgb[2]
    for hour in range(6, 19):
        light = light_named(f"{hour}h")
        assert 0 < light.sun_level <= noon.sun_level and 0 < light.sky_level <= noon.sky_level


def test_a_scene_that_is_all_dark_is_refused_in_one_line() -> None:
    board = scenes.build("board", 10)
    assert not board.lamps
    with pytest.raises(SimulatorError, match="scene 'board' has no lamp, and in this light"):
        lit_textures(board, light_named("0h"))
