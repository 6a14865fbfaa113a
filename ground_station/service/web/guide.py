"""The way from a payload to a flight: how far one is, by what is on disk and on the bus.

Steps, each with what was found of it, how to check it, and the commands that go on. A map may come
of the payload's own recording or of a phone's video; both ways are told, and how it grows with
flights. `blimp init` and the dashboard show what `Guide` says.
"""

from __future__ import annotations

import os
import shlex
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ground_station.errors import GroundStationError
from ground_station.geometry.camera import load_camera
from ground_station.map.store import MapInfo
from ground_station.mapping.construction.verdict import first_line
from ground_station.service import lan
from ground_station.service.settings import DEMO_PAYLOAD, SAMPLE, StationSettings
from ground_station.service.web.maps import Maps
from ground_station.service.web.models import Step, Way
from ground_station.service.web.problems import NotFound
from ground_station.service.web.recordings import Recordings
from pi_firmware.wire.errors import BlimpError

CAMERA, BOARD, REPORT = "camera.toml", "board.toml", "calibration.html"
PLAN = "floorplan.png"
NAMED = ("build", "extend")
"""Steps whose jobs make a map, which wants a name."""
_VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv")
_CHOICES = 50


class Guide:
    """Looks at a station's folders each time it is asked. Safe from any thread."""

    def __init__(self, settings: StationSettings, shelf: Maps, recorded: Recordings) -> None:
        self._settings, self._shelf, self._recorded = settings, shelf, recorded

    def steps(self, station: Mapping[str, Any] | None) -> list[Step]:
        """All of them; `station` is the state's document, None where no station runs."""
        heard = _heard(station)
        recordings = [item for item in self._recorded.list() if item["duration_s"]]
        maps = list(self._own_maps())
        return [
            self._payload(station, heard, recordings),
            self._calibrate(recordings),
            self._record(station, recordings),
            self._build(recordings, maps),
            self._register(maps),
            self._fly(heard, maps),
            self._extend(maps),
        ]

    def _payload(
        self, station: Mapping[str, Any] | None, heard: Mapping[str, Any], recordings: list[Any]
    ) -> Step:
        title, check = "A payload is heard", "blimp doctor --lan"
        for name, view in heard.items():
            note = view.get("payload") or {}
            if "frame" not in view.get("stale", ()) and note.get("rate_hz"):
                secure = "encrypted" if note.get("encrypted") else "not encrypted"
                found = f"{name}: {note['rate_hz']:.0f} frames a second, {secure}"
                return Step("payload", title, "done", found, check)
        if heard:
            way = Way("it speaks, and its video does not come through", "sudo blimp doctor --lan")
            found = f"{', '.join(heard)}: heard, without video"
            return Step("payload", title, "ready", found, check, [way])
        if recordings:
            newest = f"none now; the newest recording is of {_day(recordings[0])}"
            found, way = self._listening(station, newest)
        else:
            found, way = self._towards_a_payload(station)
        return Step("payload", title, "ready", found, check, [way])

    def _towards_a_payload(self, station: Mapping[str, Any] | None) -> tuple[str, Way]:
        """What stands between this computer and a payload that is heard."""
        keys = lan.authority()
        payloads = sorted(path.name for path in (keys / "payload").glob("*") if path.is_dir())
        if not keys.is_dir() and self._settings.telemetry.certificates:
            return self._listening(station, "nothing is heard")  # the keys are made elsewhere
        if not keys.is_dir():
            return "no keys yet", Way("your own authority, once", "blimp keys init")
        if not (keys / "ground" / self._settings.name).is_dir():
            ground = f"blimp keys ground {self._settings.name}"
            return "this station has no certificate", Way("once for each station", ground)
        if not payloads:
            return "no payload has keys", Way("once for each payload", "blimp keys payload blimp-1")
        flashed = sorted(path.parent.name for path in keys.glob(f"payload/*/{lan.CARD_NOTE}"))
        if not flashed:
            images = sorted(Path("out/image").glob("*.img"))
            if not images:
                return "no card is written", Way("the card's image", "make image")
            flash = f"make flash DEVICE=/dev/sdX IMAGE={shlex.quote(str(images[0]))}"
            flash += f" PAYLOAD={payloads[0]} WIFI=SSID COUNTRY=DE"
            return "no card is written", Way("with the card in this computer", flash)
        written = f"the card of {', '.join(flashed)} is written; nothing is heard of it"
        return self._listening(station, written)

    def _listening(self, station: Mapping[str, Any] | None, found: str) -> tuple[str, Way]:
        if station is None or station["station"]["loopback"]:
            return found, Way("power the payload, and listen on its network", "blimp serve --lan")
        return found, Way("power the payload; nothing after a minute?", "sudo blimp doctor --lan")

    def _calibrate(self, recordings: list[Any]) -> Step:
        title = "The payload's camera is calibrated"
        names = [str(item["file"]) for item in recordings]
        again = shlex.join(self._words("calibrate", [*names, "RECORDING.mcap"][0]))
        board = Path(BOARD).is_file()
        make = Way("once: a board to print", "blimp calibrate board --out board.pdf")
        ways = [
            Way("record the board before the camera: near and far, tilted, in all corners"),
            Way("of that recording", again),
        ]
        ways = ways if board else [make, *ways]
        check = f"open {REPORT}: small errors, and corners seen all over the picture"
        choices = names[:_CHOICES] if board else []
        path = self.camera()
        try:
            camera = load_camera(path) if path else None
        except BlimpError as error:
            return Step("calibrate", title, "ready", str(error), check, ways, choices)
        if camera is None:
            found = f"no {CAMERA}" if board else f"no {CAMERA}, and no {BOARD} to make it with"
            return Step("calibrate", title, "ready", found, check, ways, choices)
        found = f"{path}: {camera.width_px}x{camera.height_px} px, {camera.model}"
        return Step("calibrate", title, "done", found, check, [], choices)

    def _record(self, station: Mapping[str, Any] | None, recordings: list[Any]) -> Step:
        title = "The building is recorded"
        check = "play it back: Recordings (G) on the page"
        ways = [
            Way("with the payload: Record (R) on the page, and carry it through the building")
            if station is not None
            else Way("with the payload: Record (R) on the page of", "blimp serve --lan"),
            Way("with a phone: film a slow walk, and put the video into this folder"),
        ]
        found = [f"videos: {', '.join(videos[:3])}"] if (videos := _videos()) else []
        if recordings:
            found.insert(0, f"recordings: {len(recordings)}, the newest of {_day(recordings[0])}")
        if found:
            return Step("record", title, "done", "; ".join(found), check, ways)
        return Step("record", title, "ready", "no recording and no video", check, ways)

    def _build(self, recordings: list[Any], maps: list[tuple[str, MapInfo]]) -> Step:
        title = "A map is built"
        names = [str(item["file"]) for item in recordings]
        videos = _videos()
        ways = [
            Way(text, shlex.join(self._words("build", choice)))
            for text, choice in (
                ("of the payload's recording", [*names, "FLIGHT.mcap"][0]),
                ("of a phone's video, whose lens the build finds itself", [*videos, "walk.mp4"][0]),
            )
        ]
        name = maps[0][0] if maps else "NAME"
        folder = shlex.quote(self._folder(name))
        check = f"blimp map view {folder} --out {shlex.quote(f'{name}.html')} --open"
        choices = [*names[:_CHOICES], *videos[:_CHOICES]]
        if maps:
            found = f"{name}: {first_line(maps[0][1].built)}"
            return Step("build", title, "done", found, check, ways, choices)
        if names or videos:
            return Step("build", title, "ready", "no map of your own yet", check, ways, choices)
        return Step("build", title, "waiting", "needs a recording or a video", check, ways)

    def _register(self, maps: list[tuple[str, MapInfo]]) -> Step:
        title = "The map lies in the building"
        open_ones = [name for name, info in maps if not info.registered]
        name, info = maps[0] if maps else ("NAME", None)
        folder = shlex.quote(self._folder(name))
        words = self._words("register", name)
        ways = [Way("click the same places on map and floor plan", shlex.join(words))]
        if PLAN in words and not Path(PLAN).is_file():
            ways.insert(0, Way(f"put a picture of the floor plan into this folder, as {PLAN}"))
            open_ones = []
        check = f"blimp map info {folder}"
        if info is None:
            return Step("register", title, "waiting", "needs a map", check, ways)
        if not info.registered:
            found = f"{name} has no scale and no place yet"
            return Step("register", title, "ready", found, check, ways, open_ones)
        told, figure = "", info.registration.get("residual_rms_m")
        if isinstance(figure, float):
            told = f", to {100 * figure:.1f} cm of what it was given"
        return Step("register", title, "done", f"{name}: metres{told}", check, ways, open_ones)

    def _fly(self, heard: Mapping[str, Any], maps: list[tuple[str, MapInfo]]) -> Step:
        title = "The payload flies in it"
        check = "the page says TRACKING, with an error of centimetres"
        registered = [(name, info) for name, info in maps if info.registered]
        if not registered:
            return Step("fly", title, "waiting", "needs a registered map", check)
        for payload, view in heard.items():
            estimate = view.get("estimate") or {}
            if estimate.get("state") == "TRACKING" and estimate.get("map") in dict(registered):
                found = f"{payload} is tracked in {estimate['map']}"
                return Step("fly", title, "done", found, check)
        (name, info), camera = registered[0], self.camera()
        command = f"blimp serve --lan --map {shlex.quote(self._folder(name))}"
        if camera:
            command += f" --set map.camera={shlex.quote(camera)}"
        ways = [Way("or choose it by Map… (M) on a page that shows the payload", command)]
        if not camera and not all(str(x).endswith(".mcap") for x in info.built.get("inputs", [])):
            found = f"{name} was made with another camera: calibrate the payload's first"
            return Step("fly", title, "waiting", found, check, ways)
        if not heard:
            return Step("fly", title, "waiting", "needs a payload that is heard", check, ways)
        return Step("fly", title, "ready", f"{name} is ready", check, ways)

    def _extend(self, maps: list[tuple[str, MapInfo]]) -> Step:
        """Nobody must: it is there for a flight beyond the map, or in another light."""
        title, known = "The map grows with flights", dict(maps)
        flown = self._flown_in()
        newest = next(iter(flown.items()), None)
        if newest is None:
            check = f"blimp map info {shlex.quote(self._folder('NAME'))}"
            return Step("extend", title, "waiting", "needs a recorded flight in the map", check)
        file, name = newest
        check = f"blimp map info {shlex.quote(self._folder(name))}"
        times = len(known[name].extensions)
        found = f"{name}: {f'extended {times} times' if times else 'not extended yet'}"
        found += f"; recorded flights in it: {[*flown.values()].count(name)}"
        ways = [
            Way(
                "another wing or another light, of such a flight",
                shlex.join(self._words("extend", file)),
            )
        ]
        return Step("extend", title, "done", found, check, ways, [*flown][:_CHOICES])

    def _flown_in(self) -> dict[str, str]:
        """Recordings, the newest first, by the last of one's own maps that each was flown in."""
        own = {name for name, _ in self._own_maps()}
        flown = {}
        for item in self._recorded.list():
            maps = [name for name in item["maps"] if name in own]
            if maps and item["duration_s"]:
                flown[str(item["file"])] = maps[-1]
        return flown

    def camera(self) -> str:
        """The payload's calibration as it is or will be given; "" where there is none."""
        return self._settings.map.camera or (CAMERA if Path(CAMERA).is_file() else "")

    def _folder(self, name: str) -> str:
        """Where a map lies, or will."""
        try:
            return str(self._shelf.folder(name))
        except BlimpError:
            return str(Path(self._settings.map.shelf) / name)

    def job(self, station: Mapping[str, Any], step: str, choice: str, name: str) -> list[str]:
        """The command line of a step's long job: of one of its choices, and of a new map's name.

        Raises a `BlimpError` for another choice, and for a name that is taken.
        """
        if choice not in next(one.choices for one in self.steps(station) if one.name == step):
            raise NotFound(f"{choice[:80]!r}: cannot be taken for this step now")
        if step in NAMED and (not name or Path(self._folder(name)).exists()):
            raise GroundStationError(f"{name or 'the map'}: give it a name that is not taken")
        return self._words(step, choice, name)

    def _words(self, step: str, choice: str, name: str = "NAME") -> list[str]:
        """The command line of a step, of a recording, a video or a map."""
        recording = str(Path(self._settings.recording.folder) / choice)
        if step == "calibrate":
            given = [recording, "--board", BOARD, "--out", CAMERA, "--report", REPORT]
            return ["blimp", "calibrate", *given]
        if step == "register":
            folder = self._folder(choice)
            plan = [] if (Path(folder) / "floorplan.yaml").is_file() else ["--plan", PLAN]
            return ["blimp", "map", "register", folder, "--page", *plan]
        if choice.lower().endswith(_VIDEOS):  # whose camera is another than the payload's
            return ["blimp", "map", "build", choice, "--out", self._folder(name)]
        lens = ["--camera", camera] if (camera := self.camera()) else []
        doing = ["build"] if step == "build" else ["extend", self._folder(self._flown_in()[choice])]
        return ["blimp", "map", *doing, recording, *lens, "--out", self._folder(name)]

    def _own_maps(self) -> Iterator[tuple[str, MapInfo]]:
        """Those that do not ship: the station's own map first, then the newest."""
        found = []
        for name in self._shelf.names():
            try:
                folder = self._shelf.folder(name)
                if folder.resolve() == SAMPLE.resolve():
                    continue
                configured = folder.resolve() == Path(self._settings.map.folder).resolve()
                age = -(folder / "map.toml").stat().st_mtime_ns
                found.append(((not configured, age), name, self._shelf.info(name)))
            except (OSError, BlimpError):
                continue
        for _, name, info in sorted(found, key=lambda item: item[0]):
            yield name, info


def first_way(steps: list[Step]) -> str:
    """The command to go on with, after what is done last; "" where all is done."""
    last = max((k for k, step in enumerate(steps) if step.state == "done"), default=-1)
    onwards = [*steps[last + 1 :], *steps[: last + 1]]
    ready = (way.command for step in onwards if step.state == "ready" for way in step.ways)
    return next((command for command in ready if command), "")


def _heard(station: Mapping[str, Any] | None) -> dict[str, Any]:
    """The payloads that live, without the demo's."""
    if station is None:
        return {}
    demo = DEMO_PAYLOAD if station["station"]["demo"] else ""
    payloads = station["payloads"].items()
    return {name: view for name, view in payloads if view["alive"] and name != demo}


def _videos() -> list[str]:
    """Video files in the folder that commands are given in, newest first."""
    with os.scandir(".") as entries:
        found = [
            (-entry.stat().st_mtime_ns, entry.name)
            for entry in entries
            if entry.name.lower().endswith(_VIDEOS)
            and not entry.name.startswith("-")
            and entry.is_file(follow_symlinks=False)
        ]
    return [name for _, name in sorted(found)]


def _day(recording: Mapping[str, Any]) -> str:
    began_s = 1e-9 * (recording["started_ns"] or recording["modified_ns"])
    return time.strftime("%Y-%m-%d %H:%M", time.localtime(began_s))
