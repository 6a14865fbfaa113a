"""Buildings to judge in: nothing else names them, their maps are registered as people do it."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ground_station.experiments import declaration, maps
from ground_station.experiments.declaration import FlightDeclaration
from ground_station.experiments.plan import FlightJob
from ground_station.experiments.store import Store
from ground_station.files import write_json
from ground_station.geometry import poses
from ground_station.geometry.alignment import Alignment
from ground_station.map.store import Map
from ground_station.mapping.registration.observations import PointObservations

ROOT = Path(__file__).parents[2]
HELD_OUT = re.compile(r"(interior|passage|stairwell)-90\d")


def test_buildings_to_judge_in_are_named_by_the_experiments_and_nowhere_else() -> None:
    named = set()
    for top in ("pi_firmware", "ground_station", "deploy", "hw", "maps", "tests"):
        for path in (ROOT / top).rglob("*"):
            kind = (".py", ".toml", ".md", ".sh", ".json", ".yaml", ".js", ".html")
            if path.suffix in kind and HELD_OUT.search(path.read_text(errors="ignore")):
                named.add(path.name)
    assert named == {"experiments.toml"}
    declared = declaration.load(declaration.SHIPPED, ["buildings"]).experiments[0].cases
    scenes = {case.flight.scene for case in declared}
    assert len(scenes) >= 3 and all(HELD_OUT.fullmatch(scene) for scene in scenes)


def test_a_building_is_mapped_on_foot_and_registered_by_clicks_of_its_own() -> None:
    declared = declaration.load(declaration.SHIPPED, ["buildings", "buildings-fast", "fast"])
    of = {e.name: e.cases for e in declared.experiments}
    for case in of["buildings"] + of["buildings-fast"]:
        walk = case.map.flight
        assert (walk.scene, walk.plan, walk.clicked) == (case.flight.scene, "walk", 6)
        assert case.flight.clicked == 0 and walk.calibrated and case.flight.calibrated
    assert {c.map for c in of["buildings-fast"]} < {c.map for c in of["buildings"]}
    short = {e.name: e.cases for e in declaration.shortened(declared).experiments}
    assert len(short["buildings"]) == 1 and short["buildings"][0].map == of["buildings"][0].map
    assert short["fast"][0].map.images == declaration.IMAGES


def test_a_walk_that_was_cut_before_its_points_were_written_is_walked_again(tmp_path: Path) -> None:
    store = Store(tmp_path)
    walk = FlightJob("w", "walk.mcap", FlightDeclaration(clicked=6), 1)
    store.flight("walk.mcap").parent.mkdir()
    store.flight("walk.mcap").touch()
    assert not store.done(walk)
    assert store.done(replace(walk, flight=FlightDeclaration()))
    store.flight("walk.csv").touch()
    assert store.done(walk)


def known(count: int = 12) -> PointObservations:
    """Points of a room, each seen in three images."""
    rng = np.random.default_rng(2)
    return PointObservations(
        points=[f"p{k}" for k in range(count)],
        world_m=rng.uniform(0, 10, (count, 3)),
        point=np.repeat(np.arange(count), 3),
        image=[f"frame-{k % 7:06d}" for k in range(3 * count)],
        pixel_px=rng.uniform(0, 640, (3 * count, 2)),
    )


def test_a_person_clicks_a_few_points_far_apart_a_pixel_and_a_centimetre_off() -> None:
    given = known()
    walk = FlightDeclaration(scene="atrium", clicked=6)
    found = maps.clicked(given, walk, 101)
    assert len(found.points) == 6 and len(found.point) == len(found.image) == 18
    where = {name: k for k, name in enumerate(given.points)}
    true = given.world_m[[where[name] for name in found.points]]
    off_m = found.world_m - true
    assert 0.002 < np.abs(off_m).mean() < 0.02
    gaps = np.linalg.norm(true[:, None] - true[None], axis=2) + 99 * np.eye(6)
    every = np.linalg.norm(given.world_m[:, None] - given.world_m[None], axis=2) + 99 * np.eye(12)
    assert gaps.min() > every.min()
    for k, name in enumerate(found.points):
        mine, theirs = found.point == k, given.point == where[name]
        assert [i for i, m in zip(found.image, mine, strict=True) if m] == [
            i for i, m in zip(given.image, theirs, strict=True) if m
        ]
        assert 0.01 < np.abs(found.pixel_px[mine] - given.pixel_px[theirs]).mean() < 3
    again = maps.clicked(given, walk, 101)
    assert np.array_equal(again.world_m, found.world_m)
    assert len(maps.clicked(given, replace(walk, clicked=18), 1).points) == 12
    elsewhere = maps.clicked(given, replace(walk, scene="office"), 101)
    assert np.abs(elsewhere.world_m - found.world_m).min() > 0  # another building, other errors


def test_the_registrations_share_is_what_it_alone_displaces(tmp_path: Path, rooms: Map) -> None:
    places = np.random.default_rng(1).uniform(-5, 5, (20, 3))
    here = replace(rooms, folder=tmp_path)
    assert maps.displacement(here, places) is None  # registered by the truth
    turned = poses.exp(np.array([0.1, 0.2, -0.3, 0, 0, 0]))[:3, :3]
    true = Alignment(rotation=turned, translation=np.array([1.0, 2.0, 3.0]), scale=2.5)
    moved = replace(true, translation=true.translation + np.array([0.03, 0.0, 0.04]))
    write_json(tmp_path / "displacement.json", {"true": maps._plain(true),
                                                "found": maps._plain(moved)})  # fmt: skip
    off_m = maps.displacement(here, places)
    assert off_m == pytest.approx(np.full(20, 0.05))
