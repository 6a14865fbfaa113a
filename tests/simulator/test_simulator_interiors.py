"""Interiors by chance: buildings of materials that nothing is trained on, with a way round."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ground_station.feature_models import images
from ground_station.simulator import interiors, scenes
from ground_station.simulator.lighting import surface_albedo
from ground_station.simulator.plans import PHONE_CAMERA, Reference, plan_named
from ground_station.simulator.scene import Scene, SimulatorError
from ground_station.simulator.simulate import SimulationSettings, prepare_flight
from ground_station.simulator.textures import MATERIALS, TextureBank
from tests.simulator.test_simulator_scenes import nearest_surface_m

NUMBERS = range(1, 9)
OTHERS = [f"{kind}-{number}" for kind in ("passage", "stairwell") for number in range(1, 6)]


def interior(number: int) -> Scene:
    return scenes.build(f"interior-{number}", 10.0)


@pytest.mark.parametrize("name", [*(f"interior-{number}" for number in NUMBERS), *OTHERS])
@pytest.mark.parametrize(("plan", "clear_m"), [("walk", 0.5), ("tour", 0.35), ("fast", 0.5)])
def test_who_goes_round_an_interior_touches_nothing(name: str, plan: str, clear_m: float) -> None:
    scene = scenes.build(name, 10.0)
    for seed in range(3):
        flown = plan_named(plan, scene, np.random.default_rng(seed))
        position, _ = Reference(flown, 0.0).at(np.linspace(0, 130, 300))
        assert nearest_surface_m(scene, position) > clear_m


def test_odd_ones_are_halls_and_a_tour_flies_as_high_as_the_ceiling_lets_it() -> None:
    for number in NUMBERS:
        scene = interior(number)
        length, _, height = scene.size_m
        assert (height > 4, length > 14) == ((True, True) if number % 2 else (False, False))
        tour = plan_named("tour", scene, np.random.default_rng(1))
        z = Reference(tour, 0.0).at(np.linspace(0, 130, 300))[0][:, 2]
        assert 1.9 < z.min() < 2.2 and z.max() <= min(7.0, max(2.06, height - 0.89))


def test_a_passage_is_long_narrow_and_low_and_has_equal_doors() -> None:
    for name in (name for name in OTHERS if name.startswith("passage")):
        scene = scenes.build(name, 10.0)
        length, width, height = scene.size_m
        assert length > 5 * width and width < 3.5 and height < 3.3
        doors = [s for s in scene.surfaces if s.material == "door"]
        assert len(doors) >= 2 and len({s.options["print"] for s in doors}) == 1


def test_stairs_rise_by_equal_steps_to_both_galleries() -> None:
    for name in (name for name in OTHERS if name.startswith("stairwell")):
        scene = scenes.build(name, 10.0)
        plates = [s.options.get("print") for s in scene.surfaces]
        step = 2 * interiors._PLATES
        treads = [s.origin_m[2] for s, plate in zip(scene.surfaces, plates, strict=True)
                  if plate == step and s.normal[2] > 0.9]  # fmt: skip
        height = scene.size_m[2]
        for level in (0.45 * height, 0.9 * height):
            assert min(abs(np.array(treads) - level)) < 1e-9
        rises = np.diff(sorted(treads))
        assert rises.min() > 0.14 and rises.max() < 0.2 and len(treads) > 30
        kinds = [f.kind for f in scene.footprints]
        assert kinds.count("stairs") == kinds.count("balcony") == 2


def test_each_is_another_building_and_the_same_each_time() -> None:
    found = [interior(number) for number in NUMBERS]
    assert len({scene.size_m for scene in found}) == len({s.texture_seed for s in found}) == 8
    again = interior(3)
    assert again.size_m == found[2].size_m and len(again.surfaces) == len(found[2].surfaces)


def test_nothing_is_trained_on_the_materials_that_tell_an_interior() -> None:
    trained = {s.material for k in range(12) for s in interiors.build_room(1, k, 10.0).surfaces}
    names = [*(f"interior-{number}" for number in NUMBERS), *OTHERS]
    judged = {s.material for name in names for s in scenes.build(name, 10.0).surfaces}
    shared = {"door", "poster", "metal", "wood", "foliage", "sky", "concrete"}
    assert judged - shared == images.HELD_OUT and not trained & images.HELD_OUT


def test_prints_of_one_plate_are_equal_and_there_are_several(bank: TextureBank) -> None:
    scene = interior(1)
    of_plate: dict[int, list[int]] = {}
    for k, surface in enumerate(scene.surfaces):
        if surface.material == "poster" and "print" in surface.options:
            of_plate.setdefault(int(surface.options["print"]), []).append(k)  # type: ignore[call-overload]
    repeated = [same for same in of_plate.values() if len(same) > 1]
    assert repeated
    a, b = (surface_albedo(bank, scene, k) for k in repeated[0][:2])
    assert np.array_equal(a, b)


def test_wallpaper_repeats_and_laminate_is_nearly_blank(bank: TextureBank) -> None:
    def made(material: str) -> np.ndarray:
        return MATERIALS[material](bank, 212, 212, 100.0, np.random.default_rng(5))[..., 0]

    paper = made("wallpaper")
    pair = np.corrcoef(paper[:53, :53].ravel(), paper[106:159, 106:159].ravel())[0, 1]
    assert pair > 0.6
    sheet = made("laminate")[10:100, 10:100]
    assert sheet.std() / sheet.mean() < 0.06


def test_a_walk_is_with_a_phone_and_its_speed_a_walkers() -> None:
    settings = SimulationSettings(out=Path("f.mcap"), scene="interior-2", plan="walk", seed=1,
                                  texels_per_m=10.0)  # fmt: skip
    flight = prepare_flight(settings)
    assert flight.camera == PHONE_CAMERA
    speed, turn = flight.motion.speed(flight.times_s[10:])
    assert 0.4 < np.median(speed) < 0.9 and np.degrees(np.percentile(turn, 95)) < 90
    z = flight.motion.wTc(flight.times_s)[:, 2, 3]
    assert 1.4 < z.min() < z.max() < 1.8


@pytest.mark.parametrize(
    "name", ["interior-0", "interior-", "interior-1000", "interior-x", "passage-0", "stairwell-"]
)
def test_an_interior_that_is_not_there_is_refused(name: str) -> None:
    with pytest.raises(SimulatorError, match=name.partition("-")[0]):
        scenes.build(name, 10.0)


def test_a_scene_without_a_free_way_says_which_has_one() -> None:
    with pytest.raises(SimulatorError, match="--scene interior-1"):
        plan_named("walk", scenes.build("corridor", 10), np.random.default_rng(0))
