"""The page that picks are made on, in a real browser and by hand-made requests."""

from __future__ import annotations

import dataclasses
import json
import shutil
import socket
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import uvicorn
from waiting import eventually

from ground_station.errors import MapError
from ground_station.geometry.alignment import align
from ground_station.map import store
from ground_station.mapping.registration.page import serve as pages
from ground_station.mapping.registration.page.session import RegistrationSession
from ground_station.mapping.registration.picks import read_picks
from ground_station.mapping.registration.plan import load_plan
from ground_station.mapping.registration.register import register_map

LIMIT_S = 60.0
TOKEN = "a-token"
RESOLUTION_M, MARGIN_M = 0.02, 0.5


def draw_plan(folder: Path) -> Path:
    """The room of the scene, 8 x 6 m, as a picture without a scale; its corner at (0.5, 0.5) m."""
    picture = np.full((350, 450), 205, np.uint8)
    cv2.rectangle(picture, (25, 25), (424, 324), 254, -1)
    cv2.rectangle(picture, (25, 25), (424, 324), 0, 2)
    path = folder / "hall.png"
    cv2.imwrite(str(path), picture)
    return path


class Stand:
    """A session that is served on loopback, and what a test knows of it."""

    def __init__(self, folder: Path, plan: Path, built: Any) -> None:
        self.folder, self.built = folder, built
        self.session = RegistrationSession(
            folder, store.load(folder), load_plan(folder, str(plan), None), None, 0
        )
        self.ended = threading.Event()
        self.socket = socket.create_server(("127.0.0.1", 0))
        self.port = self.socket.getsockname()[1]
        app = pages.build(self.session, TOKEN, self.ended.set)
        config = uvicorn.Config(app, log_config=None, lifespan="off", timeout_graceful_shutdown=1)
        self.server = uvicorn.Server(config)
        self.thread = threading.Thread(target=self.server.run, args=([self.socket],), daemon=True)
        self.thread.start()
        eventually(lambda: self.server.started)
        self.truth = align(built.map.keyframes.wTc[:, :3, 3], built.scene.wTc[:, :3, 3], True)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/{TOKEN}/"

    def ask(self, what: str, body: Any = None, **headers: str) -> tuple[int, Any]:
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(
            self.url + what, data, {"content-type": "application/json", **headers}
        )
        try:
            with urllib.request.urlopen(request, timeout=LIMIT_S) as answer:
                return answer.status, json.loads(answer.read())
        except urllib.error.HTTPError as error:
            return error.code, json.loads(error.read())

    def pixel_of(self, place: np.ndarray) -> np.ndarray:
        """Where the plan shows a place (3,) of the map."""
        x, y = self.truth.apply(place[None])[0, :2] + MARGIN_M
        return np.array([x / RESOLUTION_M - 0.5, 350 - y / RESOLUTION_M - 0.5])

    def stop(self) -> None:
        self.server.should_exit = True
        self.thread.join(LIMIT_S)
        self.socket.close()


@pytest.fixture
def stand(built: Any, target: Path, tmp_path: Path) -> Iterator[Stand]:
    one = Stand(target, draw_plan(tmp_path), built)
    yield one
    one.stop()


@pytest.fixture(scope="module")
def untouched(built: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stand]:
    """One for all tests that change nothing."""
    folder = tmp_path_factory.mktemp("page")
    shutil.copytree(built.folder, folder / "map")
    one = Stand(folder / "map", draw_plan(folder), built)
    yield one
    one.stop()


def true_up(stand: Stand) -> dict[str, float]:
    """How far a person would tilt what the page found, and the level of the floor, in its words."""
    from ground_station.mapping.registration import upright

    turn = upright.upright_rotation(upright.find_up(stand.session.map, "cameras").upright.direction)
    up = turn @ (np.array([0, 0, 1.0]) @ stand.truth.rotation)
    # R = Rz Ry Rx of lower-case "xy" angles: up is (sin b cos a, -sin a, cos a cos b).
    a, b = -np.arcsin(up[1]), np.arctan2(up[0], up[2])
    direction = np.array([0, 0, 1.0]) @ stand.truth.rotation
    floor = (np.array([4.0, 3.0, 0.0]) - stand.truth.translation) @ stand.truth.rotation
    return {
        "tilt_x_deg": float(np.degrees(a)),
        "tilt_y_deg": float(np.degrees(b)),
        "level": float(floor @ direction / stand.truth.scale),
    }


def places_to_pick(stand: Stand) -> list[np.ndarray]:
    """Places of the map with landmarks, x and y in the top view: the ends of the walls and more."""
    turned = stand.session._turned(stand.session.map.landmarks.position_m)
    world = stand.truth.apply(stand.session.map.landmarks.position_m)
    wanted = [[8.0, 2.6], [8.0, 5.8], [5.0, 6.0], [7.2, 6.0], [8.0, 4.2]]
    return [turned[np.argmin(np.linalg.norm(world[:, :2] - w, axis=1)), :2] for w in wanted]


class Page:
    """The page, and a person's hand on it."""

    def __init__(self, browser: Any, stand: Stand) -> None:
        self.stand = stand
        self.page = browser.new_page(viewport={"width": 1440, "height": 900})
        self.page.set_default_timeout(LIMIT_S * 1e3)
        self.problems: list[str] = []
        self.page.on("pageerror", lambda error: self.problems.append(str(error)))
        self.page.on("console", self._said)
        self.page.goto(stand.url)
        self.page.wait_for_selector("body[data-ready]")

    def _said(self, message: Any) -> None:
        # The browser itself reports each refusal, which is an answer with a status.
        if message.type in ("error", "warning") and "the server responded" not in message.text:
            self.problems.append(message.text)

    def settled(self) -> None:
        eventually(lambda: not self.page.evaluate("busy"))

    def click(self, view: str, x: float, y: float) -> None:
        """A click on a place of a view: top view coordinates or the plan's pixels."""
        u, v = self.page.evaluate(f"{view}View.toScreen({x}, {y})")
        box = self.page.locator(f"#{view}").bounding_box()
        assert 0 < u < box["width"] and 0 < v < box["height"]
        self.page.mouse.click(box["x"] + 1 + u, box["y"] + 1 + v)  # its border
        self.settled()

    def pick(self, place: np.ndarray, off_px: float = 0.0) -> None:
        """One pick: in the map, then where the plan shows it, or that far beside."""
        self.click("map", *place)
        pending = self.stand.session._pending
        assert pending is not None and pending.pick is not None
        self.click("plan", *np.add(self.stand.pixel_of(pending.pick.place), [0, off_px]))

    def text(self, selector: str) -> str:
        return str(self.page.text_content(selector))

    def rows(self) -> list[list[str]]:
        return [row.split("\t")[:3] for row in self.page.inner_text("#picks").splitlines() if row]


def test_a_map_is_registered_on_the_page(browser: Any, stand: Stand, tmp_path: Path) -> None:
    """A person sets the scale, picks, sees residuals, fixes a wrong pick, and saves."""
    hand = Page(browser, stand)
    page = hand.page
    assert "no scale" in hand.text("#plan-words") and page.is_disabled("#save")
    page.click("#plan-scale")
    hand.click("plan", 24.5, 325 - 0.5)
    hand.click("plan", 424.5, 325 - 0.5)
    page.fill("#scale-length", "8")
    page.keyboard.press("Enter")
    eventually(lambda: "m a pixel" in hand.text("#plan-words"))
    assert stand.session.plan.scale.resolution_m == pytest.approx(RESOLUTION_M, rel=0.01)
    assert stand.ask("upright", {"source": "cameras", **true_up(stand)})[0] == 200
    page.reload()
    page.wait_for_selector("body[data-ready]")
    page.click("#map-turn")
    hand.settled()
    assert stand.session._quarters == 1
    places = places_to_pick(stand)
    # The wrong order, and two picks: both said, nothing lost.
    hand.click("plan", 100, 100)
    assert hand.text("#problem") == "click the place in the map first, then on the plan"
    for place in places[:2]:
        hand.pick(place)
    assert page.is_disabled("#save") and len(stand.session._picks) == 2
    for place in places[2:4]:
        hand.pick(place)
    assert page.is_enabled("#save") and page.is_hidden("#problem")
    assert "± " in hand.text("#fit") and "within" in hand.text("#fit")
    hand.pick(places[4], off_px=150.0)  # three metres off
    wrong = page.locator('tr[data-pick="5"]')
    assert "left out" in wrong.inner_text() and "out" in str(wrong.get_attribute("class"))
    assert "pick '5' left out" in hand.text("#notes")
    page.click('tr[data-pick="5"] button:has-text("again")')
    hand.settled()
    assert "Click place 5 in the map" in hand.text("#hint")
    hand.pick(places[4])
    shown = page.locator("#picks tr").all_inner_texts()
    assert len(shown) == 5 and all("cm" in row for row in shown)
    page.click('tr[data-pick="5"] button:has-text("delete")')
    hand.settled()
    assert page.locator("#picks tr").count() == 4
    page.click("#save")
    eventually(lambda: hand.text("#problem") == "Saved.")
    assert stand.ended.wait(LIMIT_S)
    assert hand.problems == []
    page.close()
    moved, scene = store.load(stand.folder), stand.built.scene
    off = moved.keyframes.wTc[:, :2, 3] - MARGIN_M - scene.wTc[:, :2, 3]
    assert moved.info.registered and np.linalg.norm(off, axis=1).max() < 0.15
    assert moved.info.registration["source"] == "PICKS.toml"
    # The same registration again, from the command line's side: nothing moves.
    again, _ = register_map(stand.folder, picks=read_picks(stand.folder / "PICKS.toml"))
    assert np.allclose(again.keyframes.wTc, moved.keyframes.wTc, atol=1e-3)
    assert load_plan(stand.folder, None, None).scale.resolution_m == pytest.approx(0.02, rel=0.01)


def test_only_who_knows_the_address_from_this_machine_gets_anything(untouched: Stand) -> None:
    def status(path: str, **headers: str) -> int:
        request = urllib.request.Request(
            f"http://127.0.0.1:{untouched.port}{path}", headers=headers
        )
        try:
            with urllib.request.urlopen(request, timeout=LIMIT_S) as answer:
                return int(answer.status)
        except urllib.error.HTTPError as error:
            return error.code

    assert status(f"/{TOKEN}/") == 200 and status(f"/{TOKEN}/state") == 200
    for path in ("/", "/state", "/a-token2/state", "/openapi.json", "/docs", f"/{TOKEN}"):
        assert status(path) == 404
    assert status(f"/{TOKEN}/state", Host="elsewhere.example") == 403


@pytest.mark.parametrize(
    ("what", "body", "words"),
    [
        ("click", {"x": 1e99, "y": 0, "radius": 1, "low": 0, "high": 1}, "x: not what"),
        ("click", {"x": 0, "y": 0, "radius": -1, "low": 0, "high": 1}, "radius of a pick is -1"),
        ("click", {"x": 1e8, "y": 0, "radius": 1, "low": -9, "high": 9}, "no landmarks"),
        ("place", {"u": 1, "v": 1}, "click the place in the map first"),
        ("place", {"u": 1}, "v: not what is expected"),
        ("delete", {"name": "\u202e9"}, "there is no pick '?9'"),
        ("scale", {"one": {"u": 1, "v": 1}, "other": {"u": 2, "v": 1}, "length_m": 3}, "1.0 px"),
        ("upright", {"source": "gut"}, "up from 'gut'; allowed"),
        ("upright", {"source": "cameras", "tilt_x_deg": 90}, "allowed: up to 45 deg"),
        ("save", {}, "has no scale: click two points"),
        ("save", {"filler": "x" * 20_000}, "a body has at most 16384 bytes"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line_and_changes_nothing(
    untouched: Stand, what: str, body: Any, words: str
) -> None:
    before = untouched.session.state()
    status, answer = untouched.ask(what, body)
    assert 400 <= status < 500 and words in answer["detail"] and "\n" not in answer["detail"]
    assert untouched.session.state() == before
    assert not store.load_info(untouched.folder).registered


def test_picks_outlive_the_program_and_the_browser(stand: Stand) -> None:
    """Two picks, and the machine goes: the next page begins with them."""
    session = stand.session
    session.scale(np.array([0.0, 0.0]), np.array([400.0, 0.0]), 8.0)
    for k, place in enumerate(places_to_pick(stand)[:4], 1):
        session.click(place, 0.1, session._up.low, session._up.high, False)
        assert session._pending is not None and session._pending.pick is not None
        session.place(stand.pixel_of(session._pending.pick.place))
        again = RegistrationSession(stand.folder, store.load(stand.folder), session.plan, None, 0)
        assert len(again.state()["picks"]) == k
    session.delete("2")
    again = RegistrationSession(stand.folder, store.load(stand.folder), session.plan, None, 0)
    shown, before = again.state(), session.state()
    assert [pick["name"] for pick in shown["picks"]] == ["1", "3", "4"]
    assert shown["picks"] == before["picks"] and "3 picks of PICKS.draft.toml" in shown["notes"]
    again.save()
    assert not (stand.folder / "PICKS.draft.toml").exists()
    assert len(read_picks(stand.folder / "PICKS.toml").picks) == 3
    renamed = dataclasses.replace(session.plan, name="other.png")
    told = RegistrationSession(stand.folder, store.load(stand.folder), renamed, None, 0)
    assert len(told.state()["picks"]) == 3
    other = dataclasses.replace(session.plan, image=255 - session.plan.image)
    told = RegistrationSession(stand.folder, store.load(stand.folder), other, None, 0)
    assert told.state()["picks"] == [] and "of another plan" in told.state()["notes"][0]


def test_picks_are_refused_until_they_determine_something(stand: Stand) -> None:
    """Too few, twice the same, and on one line."""
    session = stand.session
    session.scale(np.array([0.0, 0.0]), np.array([400.0, 0.0]), 8.0)
    places = places_to_pick(stand)
    low, high = session._up.low, session._up.high
    for k, place in enumerate(places[:2]):
        session.click(place, 0.05, low, high, False)
        session.place(np.array([50.0 + 100 * k, 50.0 + 80 * k]))
    assert stand.ask("save", {})[1]["detail"] == "2 picks; at least 3 are needed"
    session.click(places[0], 0.05, low, high, False)
    with pytest.raises(MapError, match="'1' and '3' are the same place in the map"):
        session.place(np.array([300.0, 10.0]))
    session.click(places[2], 0.05, low, high, False)
    with pytest.raises(MapError, match="'2' and '3' are the same place on the plan"):
        session.place(np.array([150.0, 130.0]))
    with pytest.raises(MapError, match="the click is beside the plan"):
        session.place(np.array([900.0, 10.0]))
    session.place(np.array([250.0, 210.0]))
    assert "picks on the plan lie on one line" in session.state()["problem"]
    assert stand.ask("save", {})[0] == 409
    assert not store.load_info(stand.folder).registered
    assert not (stand.folder / "PICKS.toml").exists()
