"""Picks on a floor plan register a map: the vertical from the map, x and y from the clicks."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from known_places import HALL_M, hall, in_map, similarity

from ground_station.errors import InputError, MapError
from ground_station.map import store
from ground_station.mapping.registration import picks as files
from ground_station.mapping.registration import plan, upright
from ground_station.mapping.registration.from_picks import by_picks
from ground_station.mapping.registration.page.clusters import cluster_at
from ground_station.mapping.registration.picks import Pick, Picks, read_picks, write_picks
from ground_station.mapping.registration.plan import PlanScale
from ground_station.mapping.registration.register import register_map

TRUTH = similarity()
SCALE = PlanScale(680, 0.025, (-0.5, -0.5, 0.0))
CLICK_PX = 1.5


@pytest.fixture(scope="module")
def place():
    made = hall(TRUTH)
    made.up = upright.find_up(made)
    return made


def picks_of(place, pillars=None, seed=0, wrong=None) -> Picks:
    """A person's picks of the hall's pillars; the one called `wrong` is three metres off."""
    rng = np.random.default_rng(seed)
    made = []
    for k, pillar in enumerate(place.pillars if pillars is None else pillars, 1):
        rows = np.flatnonzero(np.linalg.norm(place.world[:, :2] - pillar, axis=1) < 0.2)
        rows = rows[(place.world[rows, 2] > 0.2) & (place.world[rows, 2] < 5.6)]
        at = pillar + ([0.0, 3.0] if str(k) == wrong else 0.0)
        pixel = SCALE.to_pixels(at)[0] + CLICK_PX * rng.normal(size=2)
        centroid = place.landmarks.position_m[rows].mean(axis=0)
        made.append(Pick(str(k), place.landmarks.id[rows], centroid, pixel))
    return Picks(made, SCALE, place.up.upright, "floorplan.png")


@pytest.mark.parametrize("source", ["levels", "cameras"])
def test_up_is_found_in_the_map(place, source):
    found = upright.find_up(place, source)
    true_up = np.array([0, 0, 1]) @ TRUTH.rotation
    off_deg = np.degrees(np.arccos(min(1.0, found.upright.direction @ true_up)))
    assert off_deg < {"levels": 0.15, "cameras": 2.0}[source]
    assert off_deg < 3 * np.degrees(found.upright.sigma_rad)
    if source == "levels":
        floor, ceiling = (
            in_map(TRUTH, np.array([[12, 8, z]]))[0] @ true_up for z in (0, HALL_M[2])
        )
        step = (found.high - found.low) / len(found.heights)
        assert found.upright.level == pytest.approx(floor, abs=2 * step)
        assert found.ceiling == pytest.approx(ceiling, abs=2 * step)


def test_cameras_that_all_look_one_way_and_one_that_rolls_still_know_up(place):
    wTc = place.keyframes.wTc.copy()
    quarter = np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1.0]])
    wTc[:8, :3, :3] = wTc[:8, :3, :3] @ quarter  # one in ten held upright
    true_up = np.array([0, 0, 1]) @ TRUTH.rotation
    assert upright._across_cameras(wTc) @ true_up > np.cos(np.radians(2.5))
    alike = np.tile(place.keyframes.wTc[:1], (20, 1, 1))
    assert upright._across_cameras(alike) @ true_up > np.cos(np.radians(30))


def test_picks_put_the_map_onto_the_plan(place):
    found = by_picks(place.landmarks, picks_of(place), 0)
    off = np.linalg.norm(found.fit.apply(place.landmarks.position_m) - place.world, axis=1)
    assert np.median(off) < 0.10
    report = found.report
    assert report["method"] == "picks" and report["points"] == 6 and not found.notes
    assert 0 < report["residual_rms_m"] < 0.15
    assert report["held_out_rms_m"] > report["residual_rms_m"]
    assert found.uncertainty.freedom == 2 * 6 - 4
    middle = np.array([HALL_M / 2])
    assert 0.01 < found.uncertainty.radius_m(middle)[0] < 0.3
    assert 1e-4 < found.uncertainty.scale_sigma < 0.02


@pytest.mark.parametrize("wrong", ["1", "4", "6"])
def test_a_pick_that_is_three_metres_off_is_found_and_named(place, wrong):
    found = by_picks(place.landmarks, picks_of(place, wrong=wrong), 0)
    assert found.report["points"] == 5
    assert [note.split("'")[1] for note in found.notes] == [wrong]
    off = np.linalg.norm(found.fit.apply(place.landmarks.position_m) - place.world, axis=1)
    assert np.median(off) < 0.15


def test_a_plan_may_lie_askew_in_the_world():
    scale = PlanScale(100, 0.1, (3.0, -2.0, 0.3))
    pixels = np.array([[0, 0], [50, 20], [99, 99]], np.float64)
    assert np.allclose(scale.to_pixels(scale.to_world(pixels)), pixels)
    # The lower left corner of the lower left pixel is the origin.
    assert np.allclose(scale.to_world([[-0.5, 99.5]]), [[3.0, -2.0]])
    right = scale.to_world([[9.5, 99.5]])[0] - [3.0, -2.0]
    assert np.allclose(right, [np.cos(0.3), np.sin(0.3)])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda p: p[:2], "2 picks; at least 3 are needed"),
        (lambda p: [*p[:3], dataclasses.replace(p[0], name="x")], "'1' and 'x' are the same place"),
        (
            lambda p: [*p[:3], dataclasses.replace(p[3], plan_px=p[1].plan_px)],
            "'2' and '4' are the same place on the plan",
        ),
        (
            lambda p: [
                dataclasses.replace(q, plan_px=np.array([100.0 + 40 * k, 50 + 30 * k]))
                for k, q in enumerate(p)
            ],
            "picks on the plan lie on one line",
        ),
        (
            lambda p: [*p[:3], dataclasses.replace(p[3], landmarks=np.array([1]))],
            "none of the landmarks of pick '4' is in this map",
        ),
        (
            lambda p: [*p[:3], dataclasses.replace(p[3], landmarks=p[4].landmarks)],
            "it was another map",
        ),
    ],
)
def test_picks_that_determine_nothing_are_refused(place, change, words):
    made = picks_of(place)
    with pytest.raises(MapError, match=words) as caught:
        by_picks(place.landmarks, dataclasses.replace(made, picks=change(made.picks)), 0)
    assert "\n" not in str(caught.value)


def test_a_file_of_picks_says_the_same_again(place, tmp_path):
    made = picks_of(place)
    write_picks(tmp_path / files.FILE, made)
    read = read_picks(tmp_path / files.FILE)
    one, other = (by_picks(place.landmarks, p, 0).fit for p in (made, read))
    assert np.allclose(one.rotation, other.rotation) and one.scale == pytest.approx(other.scale)


def test_picks_hold_after_the_map_was_moved(place, tmp_path):
    """Their landmarks are known by number: the same registration again changes nothing."""
    made = picks_of(place)
    first = by_picks(place.landmarks, made, 0).fit
    moved = type(place.landmarks)(place.landmarks.id, first.apply(place.landmarks.position_m))
    again = by_picks(moved, made, 0).fit
    assert np.allclose(again.rotation, np.eye(3), atol=1e-6)
    assert np.allclose(again.translation, 0, atol=1e-4) and again.scale == pytest.approx(1)


_FILE = """format = 1
[plan]
image = "floorplan.png"
height_px = 680
resolution_m = 0.025
origin = [0.0, 0.0, 0.0]
[up]
direction = [0.0, 0.0, 1.0]
[[pick]]
name = "1"
landmarks = [7, 10]
place = [1.0, 2.0, 3.0]
plan_px = [10.0, 20.0]
"""


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("", "", ""),
        ("resolution_m = 0.025\n", "", r"no scale \(plan.resolution_m\)"),
        ("0.025", "nan", "'plan.resolution_m' must be a finite number"),
        ("0.025", "0.0", "'plan.resolution_m' is 0.0; allowed"),
        ("height_px = 680\n", "", "'plan.height_px' is missing"),
        ("format = 1", "format = 9", "format 9; this program reads 1"),
        ("[up]\ndirection = [0.0, 0.0, 1.0]\n", "", "the table 'up' is missing"),
        ("[0.0, 0.0, 1.0]", "[0.0, 0.0, 3.0]", "up.direction has the length 3; allowed: 1"),
        ("[0.0, 0.0, 1.0]", "[1.0]", "up.direction has 1 numbers; allowed: 3"),
        ("[7, 10]", "[]", "pick 1: 0 landmarks; allowed: 1 to"),
        ("[7, 10]", "[-7]", "pick 1: a landmark's number is not one"),
        ("[1.0, 2.0, 3.0]", "[1.0, inf, 3.0]", "finite number"),
        ("[1.0, 2.0, 3.0]", "[1.0, 1e12, 3.0]", "allowed: below 1e9"),
        ("[10.0, 20.0]", "[10.0]", "plan_px has 1 numbers; allowed: 2"),
        ('"1"', '"' + "9" * 5000 + '"', "pick 1: its name has 5000 letters; allowed: 1 to 40"),
        ("name = ", "nme = ", "unknown key 'nme'"),
        ("[plan]", "plan = 3\n[x]", "the table 'plan' is missing"),
        ("format", "[[[", "not valid TOML"),
    ],
)
def test_a_file_of_picks_that_is_wrong_is_refused_by_name(tmp_path, old, new, words):
    path = tmp_path / files.FILE
    path.write_text(_FILE.replace(old, new, 1) if old else _FILE)
    if not words:
        assert len(read_picks(path).picks) == 1
        return
    with pytest.raises(MapError, match=words) as caught:
        read_picks(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


def test_a_click_beside_a_pillar_means_the_pillar(place):
    turn = upright.upright_rotation(place.up.upright.direction)
    flat = place.landmarks.position_m @ turn.T
    mine = np.flatnonzero(np.linalg.norm(place.world[:, :2] - place.pillars[0], axis=1) < 0.2)
    middle = flat[mine].mean(axis=0)
    low, high = np.quantile(flat[:, 2], [0.2, 0.8])
    rows = cluster_at(flat, middle[:2] + 0.12, 0.2, low, high)
    assert set(rows) <= set(mine) and len(rows) > 15
    assert ((flat[rows, 2] >= low) & (flat[rows, 2] <= high)).all()
    with pytest.raises(MapError, match="no landmarks at this place"):
        cluster_at(flat, middle[:2] + 1000, 0.2, low, high)


def test_a_plan_is_the_maps_own_or_a_picture_with_its_scale(tmp_path):
    import cv2

    with pytest.raises(
        MapError, match=r"there is no floorplan.yaml in it; give a plan with --plan"
    ):
        plan.load_plan(tmp_path, None, None)
    picture = tmp_path / "p.png"
    cv2.imwrite(str(picture), np.full((40, 60), 200, np.uint8))
    assert plan.load_plan(tmp_path, str(picture), None).scale is None
    with pytest.raises(MapError, match=r"resolution is nan m a pixel; allowed: 0.0001 to 10"):
        plan.load_plan(tmp_path, str(picture), float("nan"))
    scaled = plan.load_plan(tmp_path, str(picture), 0.05)
    plan.keep_plan(tmp_path, scaled)
    kept = plan.load_plan(tmp_path, None, None)
    assert kept.scale == scaled.scale and (kept.image == scaled.image).all()
    with pytest.raises(MapError, match="says its scale itself"):
        plan.load_plan(tmp_path, str(tmp_path / "floorplan.yaml"), 0.05)
    with pytest.raises(InputError):
        plan.load_plan(tmp_path, str(tmp_path / "none.png"), 0.05)
    one, other = np.array([1.0, 1.0]), np.array([41.0, 31.0])
    assert scaled.with_distance(one, other, 10.0).scale.resolution_m == pytest.approx(0.2)
    for pair, length, words in (
        ((one, one), 1.0, "0.0 px apart; at least 5"),
        ((one, other), 0.0, "distance is 0.0 m; allowed: above 0"),
        ((one, other), float("nan"), "distance is nan m"),
        ((one, other), 1e6, "resolution is 20000"),
    ):
        with pytest.raises(MapError, match=words):
            scaled.with_distance(*pair, length)


def test_a_map_on_disk_is_registered_by_picks(built, target):
    """Through the same door as all else, and its uncertainty is kept with it."""
    map_, scene = built.map, built.scene
    from ground_station.geometry.alignment import align

    truth = align(map_.keyframes.wTc[:, :3, 3], scene.wTc[:, :3, 3], True)
    world = truth.apply(map_.landmarks.position_m)
    made = []
    for k, at in enumerate(([8.0, 3.5], [8.0, 5.5], [6.0, 6.0], [7.3, 6.0]), 1):
        near = np.argsort(np.linalg.norm(world[:, :2] - at, axis=1))[:5]
        pixel = SCALE.to_pixels(world[near, :2].mean(axis=0))[0]
        centroid = map_.landmarks.position_m[near].mean(axis=0)
        made.append(Pick(str(k), map_.landmarks.id[near], centroid, pixel))
    up = upright.with_up(map_, np.array([0, 0, 1.0]) @ truth.rotation, 0.2, "cameras").upright
    level = float(
        (np.array([8, 6, 0.0]) - truth.translation) @ truth.rotation / truth.scale @ up.direction
    )
    up = dataclasses.replace(up, level=level)
    moved, found = register_map(target, picks=Picks(made, SCALE, up), source="PICKS.toml")
    off = np.linalg.norm(moved.keyframes.wTc[:, :3, 3] - scene.wTc[:, :3, 3], axis=1)
    assert off.max() < 0.05
    kept = store.load_info(target).registration
    assert kept["method"] == "picks" and kept["source"] == "PICKS.toml"
    assert kept["corner_90_percent_m"] >= kept["centre_90_percent_m"] > 0
    assert kept == found.report | {"source": "PICKS.toml", "seed": 0}
