"""The sample building on the page: clicks stay, walls hold the map by themselves, bays do not."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from test_mapping_register_page import Page, Stand, eventually

from ground_station.errors import MapError
from ground_station.map import store
from ground_station.mapping.registration.page.clusters import anchors_at, offer_at
from ground_station.mapping.registration.plan import Plan, PlanScale, load_plan
from ground_station.mapping.registration.walls import fit_walls
from ground_station.recording.flight import trajectory_of

SAMPLE = Path(__file__).parents[3] / "maps" / "atrium"
# Of the simulated atrium, 24 x 16 m: its corners and those of the counters against its walls.
CORNERS_M = np.array(
    [[0, 0], [24, 0], [24, 16], [0, 16], [1.2, 16], [2.1, 16], [17.6, 16], [21.75, 16]], float
)


@pytest.fixture
def stand(tmp_path: Path) -> Iterator[Stand]:
    """The page on a copy of the sample map."""
    folder = tmp_path / "map"
    shutil.copytree(SAMPLE, folder, ignore=shutil.ignore_patterns("*.mcap"))
    x = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, :3, 3] = x
    same = SimpleNamespace(keyframes=SimpleNamespace(wTc=poses))
    built = SimpleNamespace(map=same, scene=SimpleNamespace(wTc=poses))
    one = Stand(folder, folder / "floorplan.yaml", built)
    yield one
    one.stop()


def shot(hand: Page, name: str) -> None:
    """A picture of the page where somebody wants to look at it."""
    if folder := os.environ.get("PAGE_PICTURES"):
        hand.page.screenshot(path=f"{folder}/{name}.png")


def truth() -> tuple[np.ndarray, np.ndarray]:
    """Keyframes' positions in the map, and of the mapping flight's truth."""
    return (
        store.load(SAMPLE).keyframes.wTc[:, :3, 3],
        trajectory_of(SAMPLE / "mapping.mcap").position_m,
    )


def test_eight_wall_corners_fit_as_they_are_clicked(browser: Any, stand: Stand) -> None:
    """A person's clicks on corners, each within 3 cm, with corners on offer and none taken."""
    hand = Page(browser, stand)
    rng = np.random.default_rng(4)
    model, world = truth()
    from ground_station.geometry.alignment import align

    into_map = align(world, model, True)
    scale = stand.session.plan.scale
    assert scale is not None
    for corner in CORNERS_M:
        place = into_map.apply(np.array([[*corner, 2.0]]))[0]
        at = stand.session._turned(place[None])[0, :2] + rng.uniform(-0.03, 0.03, 2)
        hand.click("map", *at)
        pending = stand.session._pending
        assert pending is not None and pending.pick is not None
        clicked = stand.session._turned(pending.pick.place[None])[0, :2]
        assert np.linalg.norm(clicked - at) < 0.02  # a thousandth of the screen's width
        hand.click("plan", *scale.to_pixels(corner)[0])
    shot(hand, "corners")
    assert stand.session.state()["fit"]["residual_rms_m"] <= 0.05
    assert hand.text("#picks").count("most") == 1
    assert hand.problems == []
    hand.page.close()


def test_an_offer_is_shown_taken_by_a_key_and_can_be_switched_off(
    browser: Any, stand: Stand
) -> None:
    """A click beside a pillar stays there until somebody presses S."""
    hand = Page(browser, stand)
    pillar = np.array([7.5, 2.2])
    beside = stand.session._turned(np.array([[*pillar, 2.0]]))[0, :2] + [0.25, 0.15]

    def pending() -> dict[str, Any]:
        shown: dict[str, Any] = stand.session.state()["pending"]
        return shown

    hand.click("map", *beside)
    assert pending()["offer"]["what"] == "pillar" and hand.page.is_visible("#snap")
    assert np.linalg.norm(np.array(pending()["map"][:2]) - beside) < 0.05
    assert "press S" in hand.text("#hint")
    shot(hand, "offer")
    hand.page.keyboard.press("s")
    eventually(lambda: pending()["offer"] is None)
    off_m = np.linalg.norm(stand.session._pending.pick.place[:2] - pillar)  # type: ignore[union-attr]
    assert off_m < 0.3  # within its round, of which the cameras saw one side
    hand.page.uncheck("#offers")
    hand.click("map", *beside)
    assert pending()["offer"] is None and hand.page.is_hidden("#snap")
    assert stand.ask("snap", {})[1]["detail"] == "there is no corner or pillar on offer"
    assert hand.problems == []
    hand.page.close()


def test_two_rough_clicks_and_the_walls_do_the_rest(browser: Any, stand: Stand) -> None:
    """Each click is half a metre off; the accepted fit puts the flight where it truly was."""
    hand = Page(browser, stand)
    scale = stand.session.plan.scale
    assert scale is not None
    assert hand.page.is_disabled("#walls-fit")
    for corner, off in ((CORNERS_M[0], [0.5, 0.3]), (CORNERS_M[2], [-0.4, 0.5])):
        hand.click("map", *(stand.session._turned(np.array([[*corner, 2.0]]))[0, :2] + off))
        hand.click("plan", *scale.to_pixels(corner)[0])
    hand.page.click("#walls-fit")
    hand.settled()
    shot(hand, "walls")
    said = hand.text("#walls-words")
    assert "on walls" in said and "before" in said and hand.page.is_visible("#walls-refuse")
    assert stand.session.state()["walls"]["residual_m"] <= 0.05
    hand.page.click("#walls-refuse")
    hand.settled()
    assert len(stand.session._picks) == 2 and stand.session.state()["walls"] is None
    hand.page.click("#walls-fit")
    hand.settled()
    hand.page.click("#walls-accept")
    hand.settled()
    shot(hand, "accepted")
    assert stand.session.state()["fit"]["residual_rms_m"] <= 0.05
    stand.session.save()
    placed = store.load(stand.folder).keyframes.wTc[:, :2, 3]
    off = np.linalg.norm(placed - truth()[1][:, :2], axis=1)
    assert np.median(off) <= 0.05 and off.max() < 0.10
    assert hand.problems == []
    hand.page.close()


@pytest.mark.parametrize("heights_m", [(0.3, 8.0), (1.0, 6.0)])
def test_a_walls_far_side_is_not_taken_for_its_face(heights_m: tuple[float, float]) -> None:
    """With both sides of the thick walls drawn, a scale 1 % off fitted as well."""
    map_, plan = store.load(SAMPLE), load_plan(SAMPLE, None, None)
    assert plan.scale is not None
    z = map_.landmarks.position_m[:, 2]
    flat = map_.landmarks.position_m[(z > heights_m[0]) & (z < heights_m[1]), :2]
    cameras, corners = map_.keyframes.wTc[:, :2, 3], CORNERS_M[[0, 2]]
    rough = np.add(corners, [[0.5, 0.3], [-0.4, 0.5]])
    found = fit_walls(flat, cameras, rough, plan.scale.to_pixels(corners), plan)
    w = found.a * (cameras[:, 0] - 1j * cameras[:, 1]) + found.b
    placed = plan.scale.to_world(np.stack([w.real, w.imag], axis=1))
    off = np.linalg.norm(placed - truth()[1][:, :2], axis=1)
    assert found.ambiguous == "" and np.median(off) < 0.05


def drawn(boxes: list[tuple[float, float, float, float]]) -> Plan:
    """A plan of 20 x 12 m with black boxes (low x, low y, high x, high y), 2.5 cm a pixel."""
    image = np.full((480, 800), 254, np.uint8)
    for x0, y0, x1, y1 in boxes:
        low, high = (round(x0 * 40), 480 - round(y1 * 40)), (round(x1 * 40), 480 - round(y0 * 40))
        cv2.rectangle(image, low, high, 0, -1)
    return Plan("plan.png", image, PlanScale(480, 0.025))


def on_outlines(boxes: list[tuple[float, float, float, float]], seed: int = 0) -> np.ndarray:
    """Landmarks (M, 2) on the outlines of boxes, a centimetre off them."""
    rng = np.random.default_rng(seed)
    made = []
    for x0, y0, x1, y1 in boxes:
        t = rng.uniform(0, 1, 300)
        x, y = x0 + t * (x1 - x0), y0 + t * (y1 - y0)
        made += [np.stack([x, np.full_like(x, y0)], 1), np.stack([x, np.full_like(x, y1)], 1)]
        made += [np.stack([np.full_like(y, x0), y], 1), np.stack([np.full_like(y, x1), y], 1)]
    return np.vstack(made) + 0.01 * rng.normal(size=(1200 * len(boxes), 2))


HERE = np.array([[10.0, 6.0]])
"""Of a camera: between the things that are drawn."""
ROUGH = np.array([[2.2, 2.0], [17.8, 10.1]])


def clicks() -> np.ndarray:
    return PlanScale(480, 0.025).to_pixels(np.array([[2.0, 2.0], [18.0, 10.0]]))


def test_rows_of_equal_bays_are_said_and_not_picked() -> None:
    bays = [(1.0 + k, 5.0, 1.4 + k, 7.0) for k in range(18)]
    found = fit_walls(on_outlines(bays[4:14]), HERE, ROUGH, clicks(), drawn(bays))
    assert "another place" in found.ambiguous and "fits as well" in found.ambiguous


def test_a_corridor_slides_along_itself_and_that_is_said() -> None:
    walls = [(-1.0, 3.0, 21.0, 4.0), (-1.0, 7.0, 21.0, 8.0)]
    flat = on_outlines(walls)
    flat = flat[(flat[:, 0] > 6) & (flat[:, 0] < 14)]
    found = fit_walls(flat, HERE, ROUGH, clicks(), drawn(walls))
    assert found.ambiguous


def test_a_room_of_its_own_shape_is_found_and_another_building_is_refused() -> None:
    room = [(3.0, 3.0, 9.0, 4.0), (12.0, 2.0, 13.0, 9.0), (5.0, 8.0, 10.0, 9.0)]
    found = fit_walls(on_outlines(room), HERE, ROUGH, clicks(), drawn(room))
    assert found.ambiguous == "" and found.residual_m < 0.03 and found.on.mean() > 0.9
    z = np.array([3.0 - 3.0j, 13.0 - 9.0j])  # conjugated
    back = PlanScale(480, 0.025).to_world(
        np.stack([(found.a * z + found.b).real, (found.a * z + found.b).imag], axis=1)
    )
    assert np.abs(back - [[3.0, 3.0], [13.0, 9.0]]).max() < 0.04
    noise = np.random.default_rng(1).uniform([1, 1], [19, 11], (3000, 2))
    with pytest.raises(MapError, match="of the landmarks come to lie on walls"):
        fit_walls(noise, HERE, ROUGH, clicks(), drawn(room))
    with pytest.raises(MapError, match="1 picks; two or more"):
        fit_walls(noise, HERE, ROUGH[:1], clicks()[:1], drawn(room))
    with pytest.raises(MapError, match="draws nothing in black"):
        fit_walls(noise, HERE, ROUGH, clicks(), drawn([]))


def walls_in_3d(seed: int = 0) -> np.ndarray:
    """Landmarks (M, 3) of two walls that meet at (0, 0), and of a pillar at (3, 3)."""
    rng = np.random.default_rng(seed)
    along = rng.uniform(0, 5, 1500)
    flat = np.vstack(
        [
            np.stack([along[:750], np.zeros(750)], 1),
            np.stack([np.zeros(750), along[750:]], 1),
            [3.0, 3.0] + 0.05 * rng.normal(size=(80, 2)),
        ]
    )
    flat += 0.01 * rng.normal(size=flat.shape)
    return np.column_stack([flat, rng.uniform(0, 3, len(flat))])


def test_what_is_offered_is_a_corner_or_a_pillar_and_nothing_along_a_wall() -> None:
    landmarks = walls_in_3d()
    corner = offer_at(landmarks, np.array([0.12, 0.10]), 0.2, 0.0, 3.0)
    assert corner is not None and corner.what == "corner"
    assert np.linalg.norm(corner.place) < 0.02
    pillar = offer_at(landmarks, np.array([2.9, 3.05]), 0.25, 0.0, 3.0)
    assert pillar is not None and pillar.what == "pillar"
    assert np.linalg.norm(pillar.place - 3.0) < 0.03
    for beside in ([2.5, 0.05], [0.03, 3.0], [0.5, 0.05]):
        assert offer_at(landmarks, np.array(beside), 0.2, 0.0, 3.0) is None
    rows = anchors_at(landmarks, np.array([0.4, 0.4]), 0.0, 3.0)
    assert len(rows) == 30  # of a place without landmarks, too
