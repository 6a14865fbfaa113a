"""The page of a map, in a real browser: it draws, it answers, and it asks for nothing."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from hand_made import run
from rooms_map import two_rooms

from ground_station.errors import GroundStationError
from ground_station.inspection import page, view_command
from ground_station.inspection.localizability import localizability
from ground_station.map.floorplan import FloorPlan
from ground_station.map.levelling import levelled

sys.path.append(str(Path(__file__).parents[1] / "evaluation"))  # for parsed_page
from parsed_page import Page

HOSTILE = "<script>alert(1)</script>'\" onload=x \x07\u202eevil\udcff"
DRAWN = "() => new Promise((r) => requestAnimationFrame(() => requestAnimationFrame(r)))"
DESK, NARROW = (1440, 900), (390, 844)
# Its own ways of drawing without a GPU, and advice on canvases that are read back.
OF_THE_BROWSER = ("GL Driver Message", "willReadFrequently", "GPU stall")


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """A registered map with a plan, and one without a world; names are hostile."""
    folder = tmp_path_factory.mktemp("pages")
    map_ = two_rooms()
    map_.info.name = HOSTILE
    map_.info.registration = {"method": HOSTILE, "point_names": [HOSTILE]}
    map_.info.registration["point_residual_m"] = [0.01]
    image = np.full((60, 120), 254, np.uint8)
    image[:3] = image[-3:] = image[:, 58:62] = 0
    plan = FloorPlan(image, 0.1, (0.0, 0.0, 0.0))
    page.write(folder / "world.html", map_, plan, localizability(map_, plan))
    loose = two_rooms(registered=False)
    loose.landmarks.position_m *= 1e-3  # any scale is a map's right before it is registered
    loose.keyframes.wTc[:, :3, 3] *= 1e-3
    upright = levelled(loose)
    page.write(folder / "loose.html", upright, None, localizability(upright))
    return folder


class Opened:
    """A page with all that it complained of and asked for."""

    def __init__(self, browser, path, size=DESK):
        self.page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        self.problems: list[str] = []
        self.asked: list[str] = []
        self.page.on("pageerror", lambda error: self.problems.append(str(error)))
        self.page.on("console", self._said)
        self.page.on("request", lambda request: self.asked.append(request.url[:60]))
        self.page.goto(path.as_uri())
        self.page.wait_for_selector('html[data-ready="yes"]')
        self.page.evaluate(DRAWN)

    def _said(self, message):
        expected = any(word in message.text for word in OF_THE_BROWSER)
        if message.type in ("error", "warning") and not expected:
            self.problems.append(message.text)

    def colours(self, selector):
        """How many colours the picture of an element has."""
        data = self.page.locator(selector).screenshot()
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        return len(np.unique(image[::3, ::3].reshape(-1, 3) // 8, axis=0))

    def at(self, x, y):
        """The pointer at a place of the map, in metres."""
        box = self.page.locator("#top").bounding_box()
        area = self.page.evaluate("JSON.parse(document.getElementById('figures').textContent).area")
        size = [high - low for low, high in zip(area["min"], area["max"], strict=True)]
        scale = min((box["width"] - 48) / size[0], (box["height"] - 48) / size[1])
        middle = [(low + high) / 2 for low, high in zip(area["min"], area["max"], strict=True)]
        self.page.mouse.move(
            box["x"] + box["width"] / 2 + scale * (x - middle[0]),
            box["y"] + box["height"] / 2 - scale * (y - middle[1]),
        )
        return self.page.inner_text("#readout")


@pytest.fixture(scope="module")
def desk(browser, pages):
    """The map with a plan on a desk; what it complains of in any test fails that test."""
    opened = Opened(browser, pages / "world.html")
    yield opened
    opened.page.close()


@pytest.mark.parametrize(("name", "size"), [("world", NARROW), ("loose", DESK)])
def test_the_page_draws_and_asks_for_nothing(browser, pages, name, size):
    path = pages / f"{name}.html"
    opened = Opened(browser, path, size)
    assert opened.colours("#cloud") > 25 and opened.colours("#top") > 25
    wide = opened.page.evaluate("document.documentElement.scrollWidth")
    assert wide <= size[0]
    fetched = [url for url in opened.asked if not url.startswith("data:image/png")]
    assert fetched == [path.as_uri()[:60]]
    assert opened.problems == []
    opened.page.close()


def test_a_place_is_read_and_a_heading_chosen(desk):
    opened = desk
    text = opened.at(2.0, 3.0)
    assert "x 2.0" in text and "1.50 m high" in text and "would be lost" in text
    opened.page.select_option("#heading", "0")
    text = opened.at(2.01, 3.0)
    assert "heading 0°" in text and "position ±" in text and "Lost in" in text
    before = opened.colours("#top")
    opened.page.uncheck('[data-of="top"][data-shows="layer"]')
    opened.page.evaluate(DRAWN)
    assert opened.colours("#top") < before
    opened.page.select_option("#layer", "count")
    assert int(opened.page.inner_text("#layer-bad")) < int(opened.page.inner_text("#layer-good"))
    assert opened.problems == []


def test_keys_and_colours_change_the_cloud(desk):
    opened = desk
    stage = opened.page.locator("#cloud")
    seen = [stage.screenshot()]
    stage.focus()
    keyboard = opened.page.keyboard
    for act in (
        lambda: keyboard.press("ArrowLeft"),
        lambda: keyboard.press("+"),
        lambda: opened.page.select_option("#cloud-colour", "sigma"),
    ):
        act()
        opened.page.evaluate(DRAWN)
        seen.append(stage.screenshot())
    assert len(set(seen)) == len(seen)
    assert opened.problems == []


def test_without_webgl_it_is_said_and_the_rest_works(launch, pages):
    opened = Opened(launch("--disable-gpu", "--disable-3d-apis"), pages / "world.html")
    assert "no WebGL" in opened.page.inner_text("#cloud-none")
    assert opened.colours("#top") > 25
    assert "x 2.0" in opened.at(2.0, 3.0)
    opened.page.close()


def test_names_are_text_and_the_policy_allows_one_script(pages):
    text = (pages / "world.html").read_text(encoding="utf-8")
    found = Page(text)
    scripts_ = [pairs for tag, pairs in found.tags if tag == "script"]
    assert [pairs.get("type") for pairs in scripts_].count(None) == 1
    assert "alert(1)" in found.words and "onload" not in [k for _, p in found.tags for k in p]
    policy = next(pairs["content"] for _, pairs in found.tags if "http-equiv" in pairs)
    assert policy == (
        "default-src 'none'; img-src data:; style-src 'unsafe-inline'; "
        f"script-src {page.policy(page.bundle('main'))}"
    )
    assert "http://" not in text.replace("http://www.w3.org/2000/svg", "")
    assert "\u202e" not in text and "\x07" not in text


def test_an_unregistered_map_promises_no_metres(pages):
    words = Page((pages / "loose.html").read_text(encoding="utf-8")).words
    assert "arbitrary units" in words and "floor plan and without" in words
    values = words.split("Structure")[1].split("How it was built")[0]
    assert " cm" not in values and " mm" not in values


def test_the_command_writes_page_and_figures(built, tmp_path, capsys):
    out, figures_file = tmp_path / "room.html", tmp_path / "f.json"
    words = [built.folder, "--out", out, "--headings", 4, "--json", figures_file]
    assert run(view_command, *words) == 0
    assert f"Map {built.map.info.name}" in out.read_text(encoding="utf-8")
    figures = json.loads(figures_file.read_text())["localizability"]
    assert figures["headings"] == 4 and 0 < figures["share_lost"] <= 1
    said = capsys.readouterr().out
    assert "share_lost" in said and "lengths are in the map's own units" in said
    # It is not registered: no name of a figure says metres.
    assert not [name for name in figures if name.endswith("_m")] and "_m " not in said
    with pytest.raises(GroundStationError, match="its folder does not exist"):
        run(view_command, built.folder, "--out", tmp_path / "a" / "b.html")
