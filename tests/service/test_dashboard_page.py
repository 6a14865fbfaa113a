"""The dashboard in a real browser, on a station whose bus says what a test wants it to say."""

from __future__ import annotations

import base64
import os
import re
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import web_station
from flown_station import FRAMES, FlownStation, Payload, flown, sample_flight
from waiting import eventually

from ground_station import __version__, presentation
from ground_station.geometry.camera import Camera
from ground_station.service.web.app import STATIC, static_files
from ground_station.service.web.jobs import Jobs

SHARED = Path(presentation.__file__).parent / "web"

LIMIT_MS = 20_000
SIZES = {
    "desk": (1440, 900), "landscape": (1024, 768), "tablet": (820, 1180), "phone": (390, 844),
    "phone on its side": (844, 390),
}  # fmt: skip
# It reports a refused connection or request itself, whoever waits for it; it advises on reading
# canvases back, which the tests do and the page does not; and on its way of drawing without a GPU.
OF_THE_BROWSER = ("ERR_CONNECTION", "409 (Conflict)", "willReadFrequently", "GL Driver Message")
# The page's own clock is eleven days off, in all tests: it must not matter.
WRONG_CLOCK = "const now = Date.now; Date.now = () => now() + 1e9;"
WATCH_POLICY = (
    "window.violations = []; addEventListener('securitypolicyviolation',"
    " (e) => violations.push(e.violatedDirective + ' ' + e.blockedURI));"
)


class Watched:
    """A page with all that it complained of."""

    def __init__(self, browser: Any, station: FlownStation) -> None:
        width, height = SIZES["desk"]
        size = {"width": width, "height": height}
        self.page = browser.new_context(viewport=size).new_page()
        self.page.set_default_timeout(LIMIT_MS)
        self.problems: list[str] = []
        self.hosts: set[str] = set()
        self.page.on("pageerror", lambda error: self.problems.append(str(error)))
        self.page.on("console", self._said)
        self.page.on("request", lambda request: self.hosts.add(request.url.split("/")[2]))
        self.page.add_init_script(WRONG_CLOCK)
        self.page.add_init_script(WATCH_POLICY)
        self.page.goto(station.url)
        self.page.wait_for_selector('#link[data-phase="open"]')
        self.page.evaluate("window.marker = 'not loaded again'")

    def _said(self, message: Any) -> None:
        expected = any(word in message.text for word in OF_THE_BROWSER)
        if message.type in ("error", "warning") and not expected:
            self.problems.append(message.text)

    def until(self, expression: str) -> None:
        """Waits until a JavaScript expression is true.

        Playwright's own waiting evaluates text in the page, which the policy forbids.
        """
        eventually(lambda: bool(self.page.evaluate(expression)))

    def text(self, selector: str) -> str:
        """The text of an element."""
        return str(self.page.text_content(selector))


@pytest.fixture(scope="module")
def flying(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FlownStation]:
    payloads = Payload("blimp-1"), Payload("blimp-2", sequence=100)
    with flown(tmp_path_factory.mktemp("station"), *payloads) as station:
        yield station


@pytest.fixture(scope="module")
def opened(browser: Any, flying: FlownStation) -> Iterator[Watched]:
    watched = Watched(browser, flying)
    yield watched
    watched.page.close()


@pytest.fixture
def station(flying: FlownStation, monkeypatch: pytest.MonkeyPatch) -> FlownStation:
    """As at its start, in a folder of its own without recordings."""
    monkeypatch.chdir(flying.folder)
    flying.refuse, flying.answer_s, flying.recording, flying.job = "", 0.0, False, None
    for one in flying.payloads.values():
        one.__dict__.update(Payload(one.id, one.sequence).__dict__)
    for path in (flying.folder / "recordings").iterdir():
        path.unlink()
    return flying


@pytest.fixture
def shown(opened: Watched, station: FlownStation) -> Iterator[Watched]:
    """The page of the station; what it complains of fails the test."""
    opened.page.keyboard.press("1")
    opened.until("document.querySelector('#alarms').childElementCount === 0")
    opened.until("document.querySelector('.state').dataset.state === 'tracking'")
    opened.until("!document.querySelector('[data-phase=working]')")
    station.asked.clear()
    yield opened
    assert opened.problems == []
    assert opened.page.evaluate("violations") == []
    assert opened.hosts == {f"127.0.0.1:{station.port}"}
    assert opened.page.evaluate("window.marker") == "not loaded again"


def stand_still(watched: Watched, station: FlownStation, frame: int) -> None:
    """The first payload stays at a frame of the sample, and the page shows it."""
    one = station.payloads["blimp-1"]
    one.flies = False
    time.sleep(0.1)  # a step that has begun is over then
    one.sequence = (one.sequence // FRAMES + 1) * FRAMES + frame
    x = sample_flight().positions_m[frame][0]
    watched.until(f"document.querySelector('[data-f=x]').textContent === '{x:.2f}'")


PIXEL = """([id, x, y]) => {
    const canvas = document.getElementById(id);
    const ratio = canvas.width / canvas.clientWidth;
    const [u, v] = [Math.round(x * ratio), Math.round(y * ratio)];
    return [...canvas.getContext('2d').getImageData(u, v, 1, 1).data];
}"""


def rgb(colour: str) -> list[int]:
    return [int(colour[k : k + 2], 16) for k in (1, 3, 5)]


@pytest.mark.parametrize("frame", [40, 150])
def test_the_blimp_is_drawn_where_it_is(shown: Watched, station: FlownStation, frame: int) -> None:
    stand_still(shown, station, frame)
    x_m, y_m, _ = sample_flight().positions_m[frame]
    box = shown.page.locator("#plan-above").bounding_box()
    # The whole plan, 25.5 m x 17.5 m around (12, 8), with a margin of 16 px.
    scale = min((box["width"] - 32) / 25.5, (box["height"] - 32) / 17.5)
    place = [
        box["width"] / 2 + (x_m - 12) * scale,
        box["height"] / 2 - (y_m - 8) * scale,
    ]
    tracking = rgb(
        shown.page.evaluate(
            "getComputedStyle(document.documentElement).getPropertyValue('--tracking')"
        ).strip()
    )
    eventually(lambda: shown.page.evaluate(PIXEL, ["plan-above", *place])[:3] == tracking)


def test_the_picture_is_the_newest_and_its_landmarks_lie_on_it(
    shown: Watched, station: FlownStation
) -> None:
    for frame in (60, 120):
        stand_still(shown, station, frame)
        sequence = station.payloads["blimp-1"].sequence
        shown.until(f"document.querySelector('#video-caption').textContent.includes('{sequence}')")
        url = shown.page.evaluate("document.getElementById('video-picture').toDataURL()")
        png = np.frombuffer(base64.b64decode(url.partition(",")[2]), np.uint8)
        picture = cv2.imdecode(png, cv2.IMREAD_GRAYSCALE).astype(float)
        quality = [cv2.IMWRITE_JPEG_QUALITY, station.run.station.http.jpeg_quality]
        jpeg = cv2.imencode(".jpg", sample_flight().pictures[frame // 2], quality)[1]
        assert np.abs(picture - cv2.imdecode(jpeg, cv2.IMREAD_GRAYSCALE)).mean() < 2.0
        u, v = sample_flight().points_px[frame][:2]
        box = shown.page.locator("#video-points").bounding_box()
        scale = min(box["width"] / 640, box["height"] / 480)
        place = [
            (box["width"] - 640 * scale) / 2 + (u + 0.5) * scale,
            (box["height"] - 480 * scale) / 2 + (v + 0.5) * scale,
        ]
        eventually(
            lambda place=place: (
                shown.page.evaluate(PIXEL, ["video-points", *place])[:3] == [240, 228, 66]
            )
        )


def test_the_frustum_is_the_cameras_own(shown: Watched) -> None:
    own = Camera(width_px=640, height_px=480, k1=0.1673, k2=-0.2605, p1=-1.3e-5, p2=-0.00203)
    told = own.as_page()
    load = "import('/static/js/view_rays.js').then((m) =>"
    rays = shown.page.evaluate(f"(camera) => {load} m.viewRays(camera))", told)
    per_side = shown.page.evaluate(f"() => {load} m.PER_SIDE)")
    along = np.arange(per_side) / per_side
    u = np.concatenate([along, np.ones(per_side), 1 - along, np.zeros(per_side)])
    v = np.concatenate([np.zeros(per_side), along, np.ones(per_side), 1 - along])
    border = np.stack([u * 640 - 0.5, v * 480 - 0.5], axis=1)
    assert np.allclose(rays, own.undistort(border), atol=1e-6)
    # Without a camera it is about that one's; with one that is none, a pinhole's.
    plain = np.array(shown.page.evaluate(f"() => {load} m.viewRays(null))"))
    assert np.allclose(plain, rays, atol=0.05)
    wide = Camera(fx_px=244.0, fy_px=245.0, model="fisheye", k1=-0.021, k2=0.0043)
    rays = shown.page.evaluate(f"(camera) => {load} m.viewRays(camera))", wide.as_page())
    assert np.allclose(rays, wide.undistort(wide.drawn_in(border)), atol=1e-6)
    told["distortion"] = [50.0, -900.0, 3.0, 3.0, 1000.0]
    wild = np.array(shown.page.evaluate(f"(camera) => {load} m.viewRays(camera))", told))
    assert np.isfinite(wild).all() and np.abs(wild).max() < 2


def test_the_scene_shows_the_map_and_can_be_turned(shown: Watched) -> None:
    scene = shown.page.locator("#scene-canvas")
    before = cv2.imdecode(np.frombuffer(scene.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    assert len(np.unique(before.reshape(-1, 3), axis=0)) > 50
    scene.focus()
    for _ in range(4):
        shown.page.keyboard.press("ArrowLeft")
    shown.page.wait_for_timeout(300)
    after = cv2.imdecode(np.frombuffer(scene.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    assert np.abs(after.astype(int) - before).mean() > 1.0
    shown.page.keyboard.press("0")


def test_latencies_are_by_the_stations_clock(shown: Watched, station: FlownStation) -> None:
    shown.until("Number(document.querySelector('[data-f=pose]').textContent) > 0")
    assert 20 <= float(shown.text("[data-f=pose]")) <= 60  # the station's are 40 ms
    shown.until("Number(document.querySelector('[data-f=screen]').textContent) > 0")
    assert 0 < float(shown.text("[data-f=screen]")) < 10_000
    told = re.compile(rb'to_screen_seconds_(?:sum|count){payload="blimp-1"} (\S+)')
    eventually(lambda: bool(told.search(station.web.metrics.text())))
    count, sum_s = (float(value) for value in told.findall(station.web.metrics.text()))
    assert 0 < sum_s < 10 * count


def test_an_alarm_is_loud_then_acknowledged_and_quiet_then_gone(
    shown: Watched, station: FlownStation
) -> None:
    one, row = station.payloads["blimp-1"], '[data-id="lost/blimp-1"]'
    one.state, one.reason = "LOST", "no landmarks"
    shown.page.wait_for_selector(row)
    assert re.search("blimp-1: LOST for [23] s: no landmarks", shown.text(row))
    shown.until("document.title.startsWith('⚠ blimp-1: LOST')")
    assert "LOST" in shown.text("#say")
    loud = shown.page.locator(row).bounding_box()["height"]
    shown.page.click(f"{row} button")
    shown.page.wait_for_selector(f"{row}[data-seen]")
    assert shown.page.locator(row).bounding_box()["height"] < loud
    one.state = "TRACKING"
    shown.page.wait_for_selector(row, state="detached")
    shown.until("!document.title.startsWith('⚠')")
    one.state = "LOST"  # when it comes again, it is new
    shown.page.wait_for_selector(f"{row}:not([data-seen])")


def test_states_are_said_in_words_and_old_values_are_not_shown_as_current(
    shown: Watched, station: FlownStation
) -> None:
    one = station.payloads["blimp-1"]
    one.state, one.reason = "DEGRADED", "few landmarks: 14 of 120"
    shown.until("document.querySelector('.state').dataset.state === 'degraded'")
    assert shown.text("[data-f=word]") == "Degraded"
    assert shown.text("[data-f=reason]") == "few landmarks: 14 of 120"
    assert shown.page.locator(".metrics[data-stale]").count() == 0
    one.state, one.reason = "LOST", "no landmarks"
    shown.until("document.querySelector('.state').dataset.state === 'lost'")
    shown.page.wait_for_selector(".metrics[data-stale]")
    assert "last known" in shown.text(".old-tag")
    one.alive = False
    shown.until("document.querySelector('[data-f=word]').textContent === 'Gone'")
    assert re.search(r"since \d\d:\d\d:\d\d", shown.text("[data-f=since]"))
    shown.page.wait_for_selector("#battery[data-stale]")
    shown.page.wait_for_selector("#act-relocalize:disabled")
    one.alive, one.state = True, "TRACKING"
    shown.until("document.querySelector('[data-f=word]').textContent === 'Tracking'")
    shown.page.wait_for_selector("#battery:not([data-stale])")


def test_the_payloads_firmware_is_told_and_marked_when_an_update_did_not_stay(
    shown: Watched, station: FlownStation
) -> None:
    one, place = station.payloads["blimp-1"], "#board [data-f=version]"

    def says(text: str, title: str, *, bad: bool) -> None:
        shown.until(f"document.querySelector('{place}').title === {title!r}")
        assert shown.text(place) == text
        assert shown.page.locator(f"{place}[data-bad]").count() == bad

    ours = f"{__version__}+git0123456789ab"
    one.health = {"version": ours, "release": "update"}
    says(ours, ours, bad=False)
    reason = "0.0.1+gitnew: no frames <b>within</b> 120 s"
    one.health |= {"release": "fell back", "release_reason": reason}
    says(f"fell back to {ours}", f"{ours}: {reason}", bad=True)
    one.health = {"version": "0.0.9", "release": "factory"}
    says("0.0.9", f"0.0.9: the ground station is {__version__}", bad=True)
    one.health = {}  # an older payload
    shown.until(f"document.querySelector('{place}').textContent === '–'")
    assert shown.page.locator(f"{place}[data-bad]").count() == 0


def test_a_recording_starts_and_stops(shown: Watched, station: FlownStation) -> None:
    shown.page.click("#act-record")
    shown.page.wait_for_selector("#act-record[data-on]")
    assert station.asked == [("intake", {"do": "record-start"})]
    shown.until("document.querySelector('#act-record').textContent.includes('Stop')")
    shown.page.click("#act-record")
    shown.page.wait_for_selector("#act-record:not([data-on])")
    assert station.asked[1:] == [("intake", {"do": "record-stop"})]


def test_the_steps_lead_on_and_start_a_job(
    shown: Watched, station: FlownStation, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[tuple[str, list[str]]] = []
    monkeypatch.setattr(Jobs, "start", lambda _, step, words: started.append((step, words)))
    for name in ("a", "b"):
        web_station.write_recording(station.folder / "recordings" / f"{name}.mcap")
    (station.folder / "<b>a walk<.mp4").touch()
    shown.page.keyboard.press("n")
    shown.page.wait_for_selector("#steps-dialog .step")
    rows = shown.page.locator("#steps-dialog .step").all_text_contents()
    assert len(rows) == 7 and "done" in rows[0] and "to do" in rows[3] and "later" in rows[4]
    assert "videos: <b>a walk<.mp4" in rows[2]
    assert str(station.folder) in shown.text("#steps-dialog [data-f=note]")
    build = shown.page.locator("#steps-dialog .step").nth(3)
    assert "blimp map build '<b>a walk<.mp4' --out" in build.text_content()
    build.locator("select").select_option("b.mcap")
    for name, outcome in (("atrium", "atrium: give it a name"), (" hall ", "It runs")):
        build.locator("input").fill(name)
        build.get_by_role("button", name="Start").click()
        shown.until(f"document.querySelector('.step-outcome').textContent.startsWith('{outcome}')")
    recording, out = (str(station.folder / name) for name in ("recordings/b.mcap", "maps/hall"))
    assert started == [("build", ["blimp", "map", "build", recording, "--out", out])]
    shown.page.keyboard.press("Escape")


def test_a_job_is_shown_with_its_progress_and_its_end(
    shown: Watched, station: FlownStation, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also one that another page started."""
    stopped: list[bool] = []
    monkeypatch.setattr(Jobs, "stop", lambda _: stopped.append(True))
    assert shown.page.locator("#job").is_hidden()
    job = {"step": "build", "command": "blimp map build a.mcap", "started_ns": 1, "running": True}
    job |= {"status": None, "line": "pairs: 3 of 4", "share": 0.75, "page": ""}
    station.job = job
    shown.until("document.querySelector('#job progress').value === 0.75")
    assert "75 % · pairs: 3 of 4" in shown.text("#job")
    assert shown.page.locator("#job a").is_hidden()
    shown.page.click("#job button")
    eventually(lambda: stopped == [True])
    station.job = job | {"share": None, "page": "http://127.0.0.1:4321/x/"}
    shown.until("document.querySelector('#job a').href === 'http://127.0.0.1:4321/x/'")
    for status, word in ((0, "is done"), (2, "failed"), (None, "was stopped")):
        station.job = job
        shown.until("document.querySelector('#job').dataset.phase === 'working'")
        station.job = job | {"running": False, "status": status, "share": None}
        shown.until(f"document.querySelector('#job').textContent.includes({word!r})")
    shown.page.click("#job button")
    shown.until("document.querySelector('#job').hidden")


def test_recordings_are_listed_and_deleted_by_a_second_press(
    shown: Watched, station: FlownStation
) -> None:
    recordings, file = station.folder / "recordings", "flight-000007-20260131T142530Z.mcap"
    web_station.write_recording(recordings / file, 754.2, ("atrium", "<b>hall<b>"))
    os.utime(recordings / file, (1, 1))
    (recordings / "now.mcap").touch()
    os.truncate(recordings / "now.mcap", 61_200_000)
    station.recording = True
    shown.page.wait_for_selector("#act-record[data-on]")
    shown.page.keyboard.press("g")
    shown.until("document.querySelectorAll('.recordings li').length === 2")
    assert "being written · 61 MB" in shown.text(".recordings li:nth-child(1)")
    assert shown.page.locator(".recordings li:nth-child(1) button").count() == 0
    row = ".recordings li:nth-child(2)"
    assert "<b>hall<b>, atrium · 12:34 · 0.0 MB" in shown.text(row)
    links = shown.page.locator(f"{row} a").evaluate_all("links => links.map((a) => a.pathname)")
    assert links == [f"/api/recordings/{file}", f"/api/recordings/{file}/trajectory.txt"]
    deleter = shown.page.locator(f"{row} button:last-child")
    deleter.click()
    assert (recordings / file).exists()
    deleter.click()
    shown.until("document.querySelectorAll('.recordings li').length === 1")
    assert [path.name for path in recordings.iterdir()] == ["now.mcap"]
    shown.page.keyboard.press("Escape")


def test_a_refusal_says_why_and_work_shows_that_it_works(
    shown: Watched, station: FlownStation
) -> None:
    station.refuse, station.answer_s = "the localizer is loading a map", 0.7
    working = shown.page.evaluate(
        """() => {
            const button = document.getElementById('act-relocalize');
            button.click();
            const shows = button.dataset.phase === 'working' && button.ariaBusy === 'true';
            button.click(); // while it works it asks nothing more
            return shows;
        }"""
    )
    assert working
    shown.page.wait_for_selector('#act-relocalize[data-phase="refused"]')
    assert "refused: the localizer is loading a map" in shown.text("#outcome")
    assert station.asked == [("localizer/blimp-1", {"do": "relocalize"})]


def test_what_is_dangerous_wants_the_payloads_name(shown: Watched, station: FlownStation) -> None:
    shown.page.click("#act-power")
    assert shown.page.locator("#power-shutdown").is_disabled()
    shown.page.fill("#power-word", "blimp-2")
    assert shown.page.locator("#power-shutdown").is_disabled()
    shown.page.fill("#power-word", "blimp-1")
    shown.page.keyboard.press("Enter")
    assert station.asked == []
    shown.page.click("#power-shutdown")
    eventually(lambda: len(station.asked) == 1)
    asked = {"do": "payload-command", "payload": "blimp-1", "name": "shutdown", "arguments": {}}
    assert station.asked == [("intake", asked)]


def test_a_map_is_chosen_and_one_without_a_plan_has_a_grid(
    shown: Watched, station: FlownStation
) -> None:
    name = "great-hall-of-the-east-wing"
    ignored = shutil.ignore_patterns("*.mcap", "*.jpg", "floorplan.*")
    shutil.copytree(web_station.ATRIUM, station.folder / "maps" / name, ignore=ignored)
    shown.page.click("#act-map")
    shown.page.click(f"text={name}")
    shown.page.wait_for_selector("#plan-empty:not([hidden])")
    assert station.asked == [("localizer/blimp-1", {"do": "map", "name": name})]
    assert "no floor plan" in shown.text("#plan-empty")
    station.payloads["blimp-1"].map = "atrium"
    shown.page.wait_for_selector("#plan-empty", state="hidden")
    shutil.rmtree(station.folder / "maps" / name)


def test_another_station_s_payload_says_with_whom_it_flies_and_is_sent_elsewhere(
    shown: Watched, station: FlownStation, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = {
        "name": "attic", "version": "1", "map": "atrium", "same_map": True, "load": 0.2,
        "age_s": 0.2, "clock_s": 0.0, "recording": False, "payloads": ["blimp-2"],
    }  # fmt: skip
    fleet = {
        "stations": [other],
        "offers": [],
        "pins": {"blimp-1": "attic"},
        "twins": {},
        "refused": [],
    }
    monkeypatch.setattr(station.web.snapshot, "fleet", lambda: fleet)
    monkeypatch.setitem(station.payloads["blimp-2"].__dict__, "station", "attic")
    shown.until("document.querySelector('#station-name').textContent.endsWith(' + attic')")
    shown.until("document.querySelector('#payloads').textContent.includes('blimp-2 · attic')")
    shown.page.click("#act-map")
    shown.page.wait_for_selector("#map-dialog [aria-current='true'] >> text=Station attic")
    with shown.page.expect_response("**/api/payloads/blimp-1/station") as asked:
        shown.page.click("#map-dialog >> text=Whichever station has room")
    assert asked.value.request.post_data_json == {"name": ""} and asked.value.status == 404
    shown.page.wait_for_selector("#outcome[data-phase=refused]")
    eventually(lambda: len(shown.problems) == 1)
    assert "404 (Not Found)" in shown.problems.pop()
    other["age_s"] = 9.0
    shown.until("!document.querySelector('#station-name').textContent.includes('attic')")


def test_the_bar_tells_of_all_payloads_where_each_is_and_for_how_long_yet(
    shown: Watched, station: FlownStation
) -> None:
    facts = "[...document.querySelectorAll('.payload small')].map((one) => one.textContent).join()"
    shown.until(f"{facts} === '1.5 m · 80 %,1.5 m · 80 %'")
    station.payloads["blimp-2"].state = "LOST"
    shown.until(f"{facts} === '1.5 m · 80 %,– m · 80 %'")


def test_a_map_that_grew_at_another_station_is_fetched_and_chosen(
    shown: Watched, station: FlownStation, monkeypatch: pytest.MonkeyPatch
) -> None:
    offer = {"station": "attic", "map": "hall-2", "more": 1240}
    fleet = {"stations": [], "offers": [offer], "pins": {}, "twins": {}, "refused": []}
    monkeypatch.setattr(station.web.snapshot, "fleet", lambda: fleet)
    shown.until("document.querySelector('#alarms').textContent.includes('1240 landmarks more')")
    shown.page.route(
        "**/api/stations/attic/maps/hall-2",
        lambda route: route.fulfill(json={"done": True, "reason": "", "values": {"map": "atrium"}}),
    )
    shown.page.click("#act-map")
    shown.page.click("#map-dialog >> text=of station attic")
    # Playwright answers for the station only while it is itself asked something.
    shown.until("document.querySelector('#outcome').textContent === 'Map atrium, blimp-1: done'")
    assert ("localizer/blimp-1", {"do": "map", "name": "atrium"}) in station.asked


def test_events_are_newest_first_bounded_filtered_and_never_markup(
    shown: Watched, station: FlownStation
) -> None:
    for k in range(450):
        station.event(("info", "warning", "alarm")[k % 3], f"event {k}")
        if k % 30 == 29:  # a viewer's queue is short
            shown.until(
                f"document.querySelector('.event .text')?.textContent.includes('event {k}')"
            )
    station.event("alarm", "<img src=x onerror=alert(1)><b>bold</b>")
    shown.until("document.querySelector('.event .text')?.textContent.includes('<b>bold</b>')")
    assert shown.page.locator(".event").count() == 200
    assert "event 449" in shown.text(".event:nth-child(2) .text")
    shown.page.click('.events [data-level="alarm"]')
    shown.until("document.querySelectorAll('.event:not([data-level=alarm])').length === 0")
    assert shown.page.locator(".event").count() > 100
    shown.page.click('.events [data-level="info"]')


def test_keys_do_what_the_help_says(shown: Watched, station: FlownStation) -> None:
    keys = shown.page.keyboard
    keys.press("?")
    shown.page.wait_for_selector("#help-dialog[open]")
    assert "Relocalize" in shown.text("#help-keys")
    keys.press("Escape")
    shown.page.wait_for_selector("#help-dialog", state="hidden")
    keys.press("l")
    eventually(lambda: ("localizer/blimp-1", {"do": "relocalize"}) in station.asked)
    keys.press("2")
    shown.page.wait_for_selector('.payload[aria-label^="blimp-2"][aria-checked="true"]')
    shown.until("document.querySelector('#video-caption').textContent.includes('frame')")
    keys.press("f")
    shown.page.wait_for_selector('#plan-follow[aria-pressed="true"]')
    keys.press("0")
    shown.page.wait_for_selector('#plan-follow[aria-pressed="false"]')
    below = "document.getElementById('plan-below').toDataURL()"
    shown.page.wait_for_timeout(300)
    before = shown.page.evaluate(below)
    shown.page.focus("#plan-above")
    keys.press("ArrowRight")
    eventually(lambda: shown.page.evaluate(below) != before)
    keys.press("0")


def test_thirty_estimates_a_second_do_not_lay_the_page_out_thirty_times(shown: Watched) -> None:
    session = shown.page.context.new_cdp_session(shown.page)
    session.send("Performance.enable")

    def metrics() -> dict[str, float]:
        found = session.send("Performance.getMetrics")["metrics"]
        return {metric["name"]: metric["value"] for metric in found}

    begin = metrics()
    shown.page.wait_for_timeout(2000)
    end = metrics()
    span_s = end["Timestamp"] - begin["Timestamp"]
    # Text that people read changes seven times a second at most; an event or a tick may add some.
    assert (end["LayoutCount"] - begin["LayoutCount"]) / span_s < 20
    session.detach()


LONG_NAME = "a-very-long-name-of-a-payload-17"


@pytest.fixture(scope="module")
def crowded(browser: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Watched]:
    """A page of three payloads, of which one is hot and has the longest name that there may be."""
    names = "blimp-1", "blimp-2", LONG_NAME
    payloads = [Payload(name, sequence=40 * k) for k, name in enumerate(names)]
    payloads[-1].health = {"temperature_C": 82.0}
    with flown(tmp_path_factory.mktemp("crowded"), *payloads) as station:
        watched = Watched(browser, station)
        watched.page.wait_for_selector(f'[data-id="hot/{LONG_NAME}"]')
        yield watched
        watched.page.close()


@pytest.mark.parametrize("size", list(SIZES))
def test_nothing_runs_over_its_edge(crowded: Watched, size: str) -> None:
    width, height = SIZES[size]
    crowded.page.set_viewport_size({"width": width, "height": height})
    crowded.page.wait_for_timeout(300)
    over = crowded.page.evaluate(
        """selectors => {
          // Of a machine that cannot follow; the page's own are back at its next look.
          for (const name of ["pose", "screen", "pose99", "screen99"])
            document.querySelector(`[data-f=${name}]`).textContent = "13929";
          return [...document.querySelectorAll(selectors)]
            .filter((node) => node.scrollWidth > node.clientWidth + 1)
            .map((node) => `${node.className}: ${node.textContent.trim().slice(0, 40)}`);
        }""",
        "html, .bar, .page, .metric, .lines div, .lines i, .big, .pairs, "
        ".fates td:first-child, .act span, .state-word, .alarm, .banner",
    )
    assert over == []
    # State, charge and commands are in sight wherever one has scrolled to.
    out_of_sight = crowded.page.evaluate(
        """() => {
          document.querySelector(".events").scrollIntoView();
          const seen = (node) => {
            const box = node.getBoundingClientRect();
            return box.height && box.top >= 0 && box.bottom <= innerHeight;
          };
          return [".payload[aria-checked=true] use", ".act", "#bar-battery b, #battery b"]
            .filter((name) => ![...document.querySelectorAll(name)].some(seen));
        }"""
    )
    assert out_of_sight == []


def test_views_colours_and_the_order_of_values_are_chosen_and_remembered(
    shown: Watched, station: FlownStation
) -> None:
    ground, light = "getComputedStyle(document.body).backgroundColor", "rgb(233, 237, 240)"
    assert shown.page.evaluate(ground) == light
    shown.page.click('.video [data-do="swap"]')
    assert shown.page.get_attribute(".plan", "data-place") == "side"
    shown.page.click("#help-open")
    shown.page.click('[data-scheme="dark"]')
    shown.page.keyboard.press("Escape")
    order = "[...document.querySelectorAll('.rail > [id]')].map((card) => card.id).join(' ')"
    tops = (
        "[...document.querySelectorAll('.rail > [id]')].map((card) =>"
        " card.getBoundingClientRect().top).every((top, k, all) => !k || top > all[k - 1])"
    )
    assert shown.page.evaluate(order) == "battery radio board timing"
    shown.page.click('#timing [data-do="up"]')
    shown.page.keyboard.press("Enter")  # it has the focus, still
    assert shown.page.evaluate(order) == "battery timing radio board"
    another = shown.page.context.new_page()
    another.goto(station.url)
    another.wait_for_selector('.video[data-place="main"]')
    assert another.evaluate(ground) == shown.page.evaluate(ground) != light
    assert another.evaluate(order) == "battery timing radio board" and another.evaluate(tops)
    another.set_viewport_size({"width": 390, "height": 844})
    assert another.evaluate(tops)
    another.click('#battery [data-do="up"]')  # the first goes to the end
    assert another.evaluate(order) == "timing radio board battery"
    another.evaluate("localStorage.setItem('blimp.values', 'frames nonsense radio')")
    another.reload()
    another.wait_for_selector('#link[data-phase="open"]')
    assert another.evaluate(order) == "battery board timing radio"
    another.evaluate("localStorage.removeItem('blimp.values')")
    another.close()
    for _ in range(2):
        shown.page.click('#timing [data-do="up"]')
    assert shown.page.evaluate(order) == "battery radio board timing"
    shown.page.click("#help-open")
    shown.page.click('[data-scheme=""]')
    assert shown.page.evaluate(ground) == light
    shown.page.keyboard.press("Escape")
    shown.page.click('.plan [data-do="swap"]')


def test_who_is_signed_out_is_asked_for_the_token(browser: Any, tmp_path: Path) -> None:
    with flown(tmp_path, Payload("blimp-1")) as station:
        watched = Watched(browser, station)
        station.stop()
        station.start(token=web_station.TOKEN)
        watched.page.wait_for_url("**/login")
        watched.page.close()


def test_a_station_that_was_gone_is_taken_up_again_without_a_reload(
    shown: Watched, station: FlownStation
) -> None:
    station.stop()
    shown.page.wait_for_selector("#offline:not([hidden])")
    assert re.search(r"No connection to the station since \d\d:\d\d:\d\d", shown.text("#offline"))
    shown.until("document.title.startsWith('⚠ No connection')")
    shown.until("document.querySelector('[data-f=word]').textContent === 'Offline'")
    shown.page.wait_for_selector(".metrics[data-stale]")
    station.start()
    shown.page.wait_for_selector("#offline", state="hidden")
    shown.until("document.querySelector('[data-f=word]').textContent === 'Tracking'")
    caption = shown.text("#video-caption")
    eventually(lambda: shown.text("#video-caption") != caption)


def test_the_files_load_nothing_from_elsewhere_and_need_no_markup_in_data() -> None:
    for path in (*STATIC.rglob("*.*"), *SHARED.rglob("*.*")):
        text = path.read_text()
        urls = set(re.findall(r"https?://[^\s\"'`)]+", text)) - {"http://www.w3.org/2000/svg"}
        assert not urls, path
        for word in (
            "innerHTML",
            "outerHTML",
            "insertAdjacentHTML",
            "eval(",
            "Date.now",
            "@import",
        ):
            assert word not in text, f"{path}: {word}"
        if path.suffix == ".js":
            assert text.startswith("// @ts-check"), path
            assert text.count("\n") < 250, path
    page = (STATIC / "index.html").read_text()
    assert not re.search(r"<style|\sstyle=|\son\w+=|<script(?![^>]*src=)", page)
    ids = re.findall(r'\sid="([^"]+)"', page)
    assert len(ids) == len(set(ids))


def test_each_script_that_a_script_imports_is_served() -> None:
    served = static_files(STATIC)
    for path in (*STATIC.rglob("*.js"), *SHARED.rglob("*.js")):
        for name in re.findall(r"""(?:from|import\() ?"\./(\w+\.js)\"""", path.read_text()):
            assert served.lookup_path(f"js/{name}")[1] is not None, f"{path}: {name}"
    panels = re.findall(r'data-panel="(\w+)"', (STATIC / "index.html").read_text())
    for name in panels:
        assert "export class Panel " in (STATIC / f"js/{name}.js").read_text()
    assert {"flight", "board", "timing", "events"} <= set(panels)


def test_text_stands_out_from_its_ground() -> None:
    light, dark = ((STATIC / name).read_text() for name in ("tokens.css", "dark.css"))
    colours = dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6})", light))
    pairs = [
        *[("ink", ground) for ground in ("ground", "surface", "raised", "degraded-fill")],
        *[("ink-soft", ground) for ground in ("ground", "surface", "raised")],
        *[("ink", f"{state}-fill") for state in ("tracking", "initializing", "gone", "none")],
        *[(state, "surface") for state in ("tracking", "degraded", "lost", "initializing")],
        *[("on-lost", "lost-fill"), ("accent", "surface"), ("accent", "initializing-fill")],
    ]
    for table in (colours, colours | dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6})", dark))):
        for ink, ground in pairs:
            ratio = contrast(table[ink], table[ground])
            assert ratio >= 4.5, f"{ink} {table[ink]} on {ground} {table[ground]}: {ratio:.2f}"


def contrast(ink: str, ground: str) -> float:
    """WCAG 2.2's contrast ratio."""

    def luminance(colour: str) -> float:
        c = np.array(rgb(colour)) / 255
        linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    low, high = sorted((luminance(ink), luminance(ground)))
    return (high + 0.05) / (low + 0.05)
