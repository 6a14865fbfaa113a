"""The dashboard plays a recording back: in the same views, with a time line and its alarms."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import web_station as station
from tape_stand import ALARM_S, OTHER, SECONDS, P, serving, write, x_of

LIMIT_MS = 20_000
SHOWN_X = "Number(document.querySelector('[data-f=x]').textContent)"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("station")


@pytest.fixture(scope="module")
def port(folder: Path) -> Iterator[int]:
    with serving(folder, write(folder / "flown.mcap")) as port:
        yield port


@pytest.fixture(scope="module")
def opened(browser: Any, port: int) -> Iterator[Any]:
    """The dashboard, with all that it complains of."""
    page = browser.new_context(viewport={"width": 1440, "height": 900}).new_page()
    page.set_default_timeout(LIMIT_MS)
    problems: list[str] = []
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.goto(f"http://127.0.0.1:{port}/")
    yield page
    page.context.close()
    assert problems == []


@pytest.fixture
def page(opened: Any) -> Any:
    """It shows what is live."""
    opened.keyboard.press("Escape")
    if opened.locator("#tape").is_visible():
        opened.locator("#tape").get_by_role("button", name="Back to live").click()
    opened.wait_for_selector('#link[data-phase="open"]')
    until(opened, "document.querySelector('#tape').hidden")
    return opened


def until(page: Any, expression: str) -> None:
    station.eventually(lambda: page.evaluate(expression))


def play(page: Any, file: str = "flight.mcap") -> None:
    page.keyboard.press("g")
    page.locator(".recordings li", has_text=file).get_by_role("button", name="Play").click()


def seek(page: Any, at_s: float) -> None:
    page.evaluate(
        """(at_s) => {
            const line = document.querySelector('#tape [data-f=line]');
            line.value = at_s;
            line.dispatchEvent(new Event('change'));
        }""",
        at_s,
    )


def test_every_view_shows_the_flight_as_it_was(page: Any) -> None:
    assert page.locator("#tape").is_hidden()
    play(page)
    until(page, "document.querySelector('#video-caption').textContent.startsWith('frame')")
    until(page, "document.querySelector('#payloads').textContent.includes('blimp-1')")
    page.keyboard.press(" ")
    until(page, "document.querySelector('#tape use').getAttribute('href') === '#i-play'")
    for at_s in (11.0, 3.0):  # also back
        seek(page, at_s)
        until(page, f"Math.abs({SHOWN_X} - {x_of(at_s)}) < 0.05")
        until(
            page, f"document.querySelector('#tape [data-f=time]').textContent === '0:{at_s:02.0f}'"
        )
        until(page, "document.querySelector('.state').dataset.state === 'tracking'")
    assert page.text_content("#tape [data-f=length]") == f"0:{int(SECONDS - 0.1):02d}"
    # It stands still, and is not called old for that.
    page.wait_for_timeout(2500)
    assert page.evaluate("document.querySelector('.state').dataset.state") == "tracking"
    assert page.locator("#video-picture[data-stale]").count() == 0
    for command in ("record", "relocalize", "idr", "power", "map", "payload-record"):
        assert page.locator(f"#act-{command}").is_disabled(), command
    page.locator("#payloads button", has_text=OTHER).click()
    until(page, f"document.querySelector('[aria-checked=true]').textContent.includes('{OTHER}')")


def test_an_alarm_stands_on_the_time_line_and_leads_to_its_moment(page: Any) -> None:
    play(page)
    mark = page.locator(".tape-mark")
    mark.wait_for()
    assert mark.get_attribute("data-level") == "alarm"
    assert mark.get_attribute("title") == f"0:06 {P}: LOST for 2 s: searching"
    line, place = page.locator(".tape-marks").bounding_box(), mark.bounding_box()
    share = (place["x"] + place["width"] / 2 - line["x"]) / line["width"]
    assert share == pytest.approx(ALARM_S / SECONDS, abs=0.01)
    page.keyboard.press(" ")
    mark.click()
    until(page, f"Math.abs({SHOWN_X} - {x_of(ALARM_S - 2)}) < 0.05")
    seek(page, 8.8)
    page.wait_for_selector(f'[data-id="lost/{P}"]')
    seek(page, 13.0)
    page.wait_for_selector(f'[data-id="lost/{P}"]', state="detached")


def test_the_way_back_to_live_is_always_there_and_leaves_nothing(page: Any) -> None:
    play(page)
    until(page, "document.querySelector('#payloads').textContent.includes('blimp-1')")
    page.locator("#tape").get_by_role("button", name="Back to live").click()
    until(page, "document.querySelector('[data-f=word]').textContent === 'No payload'")
    until(page, "!document.querySelector('#payloads button')")
    assert page.locator("#tape").is_hidden()
    assert page.text_content("#events-count") == "0"
    until(page, "!document.querySelector('#act-record').disabled")


def test_one_that_lies_at_another_station_is_played_from_there(page: Any) -> None:
    file = {"file": "there.mcap", "size_MB": 1.0, "modified_ns": 9e18, "started_ns": 9e18}
    file |= {"duration_s": 9.0, "maps": [], "lacks": None, "after": "", "active": False}
    page.route("**/api/stations/attic/recordings", lambda route: route.fulfill(json=[file]))
    stations = (
        "(names) => import('/static/js/store.js').then(({ Store }) => {"
        " [Store.prototype.otherStations, window.own] = [names ? () => names : window.own,"
        " Store.prototype.otherStations]; })"
    )
    page.evaluate(stations, ["attic"])
    with page.expect_websocket() as opened:
        play(page, "there.mcap")
    assert opened.value.url.endswith("/api/stations/attic/recordings/there.mcap/play")
    until(page, "document.querySelector('#link').dataset.phase === 'open'")
    assert "no station 'attic' flies beside this one" in page.text_content("#outcome")
    page.evaluate(stations, None)


def test_one_that_cannot_be_played_is_said_and_the_live_page_is_back(
    page: Any, folder: Path
) -> None:
    (folder / "recordings" / "broken.mcap").write_bytes(b"no recording")
    play(page, "broken.mcap")
    until(page, "document.querySelector('#outcome').textContent.includes('no MCAP')")
    until(page, "document.querySelector('#link').dataset.phase === 'open'")
    assert page.locator("#tape").is_hidden()
    (folder / "recordings" / "broken.mcap").unlink()
