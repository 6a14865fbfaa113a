"""The way from a payload to a flight: what is on disk and on the bus decides how far one is."""

from __future__ import annotations

import json
import shlex
import shutil
from pathlib import Path
from typing import Any

import pytest
import web_station as station

from ground_station import cli
from ground_station.cli import parser as blimp
from ground_station.errors import GroundStationError
from ground_station.service.settings import (
    MapSettings,
    RecordingSettings,
    StationSettings,
    TelemetrySettings,
)
from ground_station.service.web.guide import Guide, first_way
from ground_station.service.web.maps import Maps
from ground_station.service.web.models import Step
from ground_station.service.web.recordings import Recordings

CAMERA = """width_px = 640
height_px = 480
fx_px = 500.0
fy_px = 500.0
cx_px = 319.5
cy_px = 239.5
"""


@pytest.fixture(autouse=True)
def room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder to give commands in, and a home without keys."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "home"))
    monkeypatch.delenv("SUDO_USER", raising=False)
    return tmp_path


def guide(**map_: Any) -> Guide:
    settings = StationSettings(
        map=MapSettings(**{"folder": str(station.ATRIUM), **map_}), recording=RecordingSettings()
    )
    recorded = Recordings(Path(settings.recording.folder), lambda: "")
    return Guide(settings, Maps(settings.map), recorded)


def told(of: Guide, document: Any = None) -> dict[str, Step]:
    return {step.name: step for step in of.steps(document)}


def states(of: Guide, document: Any = None) -> list[str]:
    return [step.state for step in of.steps(document)]


def heard(estimate: Any = None, demo: bool = False, **payload: Any) -> dict[str, Any]:
    """A station's document with one payload."""
    view = {"alive": True, "stale": [], "payload": {"rate_hz": 29.9, "encrypted": True, **payload}}
    return {
        "station": {"demo": demo, "loopback": False},
        "payloads": {"demo" if demo else "blimp-1": {**view, "estimate": estimate}},
    }


def record(name: str = "flight.mcap", *maps: str) -> None:
    Path("recordings").mkdir(exist_ok=True)
    station.write_recording(Path("recordings", name), maps=maps)


def own_map(name: str = "hall", registered: bool = True, inputs: str = "flight.mcap") -> None:
    folder = Path("maps", name)
    shutil.copytree(station.ATRIUM, folder, ignore=shutil.ignore_patterns("*.mcap", "*.jpg"))
    text = (folder / "map.toml").read_text().replace("mapping.mcap", inputs)
    if not registered:
        text = text.replace('frame = "world"', 'frame = "sfm"')
        (folder / "floorplan.yaml").unlink()
    (folder / "map.toml").write_text(text)


def test_it_begins_with_keys_and_goes_on_as_each_is_made() -> None:
    assert states(guide()) == [*["ready"] * 3, *["waiting"] * 4]
    keys = Path("home/blimp/keys")
    for made, command in (
        (None, "blimp keys init"),
        (keys, "blimp keys ground main"),
        (keys / "ground/main", "blimp keys payload blimp-1"),
        (keys / "payload/blimp-7", "make image"),
    ):
        if made:
            made.mkdir(parents=True)
        assert first_way(guide().steps(None)) == command
    Path("out/image").mkdir(parents=True)
    Path("out/image/a b.img").touch()
    assert first_way(guide().steps(None)) == (
        "make flash DEVICE=/dev/sdX IMAGE='out/image/a b.img' PAYLOAD=blimp-7 WIFI=SSID COUNTRY=DE"
    )
    (keys / "payload/blimp-7/flashed.json").touch()
    assert first_way(guide().steps(None)) == "blimp serve --lan"
    lan = {"station": {"demo": False, "loopback": False}, "payloads": {}}
    assert first_way(guide().steps(lan)) == "sudo blimp doctor --lan"
    lan["station"]["loopback"] = True
    assert first_way(guide().steps(lan)) == "blimp serve --lan"


def test_keys_that_were_made_elsewhere_are_not_asked_for() -> None:
    """As of an installed service, whose user has none but its certificates."""
    telemetry = TelemetrySettings(["tls/0.0.0.0:7447"], certificates="/etc/blimp")
    settings = StationSettings(map=MapSettings(folder=str(station.ATRIUM)), telemetry=telemetry)
    of = Guide(settings, Maps(settings.map), Recordings(Path("recordings"), lambda: ""))
    lan = {"station": {"demo": False, "loopback": False}, "payloads": {}}
    assert first_way(of.steps(lan)) == "sudo blimp doctor --lan"
    assert first_way(of.steps(None)) == "blimp serve --lan"


def test_a_payload_counts_when_its_video_comes_and_the_demos_does_not() -> None:
    assert told(guide(), heard())["payload"].state == "done"
    assert "30 frames a second, encrypted" in told(guide(), heard())["payload"].found
    silent = told(guide(), heard(rate_hz=0.0))["payload"]
    assert silent.state == "ready" and silent.ways[0].command == "sudo blimp doctor --lan"
    assert told(guide(), heard(demo=True))["payload"].state == "ready"
    record()
    assert "the newest recording is of" in told(guide())["payload"].found
    assert told(guide())["payload"].ways[0].command == "blimp serve --lan"


def test_with_the_payloads_own_recording() -> None:
    """payload, calibrate, record, build, register, fly: each is done by what it leaves."""
    Path("board.toml").touch()
    record("20261125 board.mcap")  # no name of a recording: it is not offered
    record("board.mcap")
    steps = told(guide(), heard())
    assert steps["calibrate"].state == "ready" and steps["calibrate"].choices == ["board.mcap"]
    assert steps["calibrate"].ways[-1].command == (
        "blimp calibrate recordings/board.mcap --board board.toml --out camera.toml"
        " --report calibration.html"
    )
    Path("camera.toml").write_text("nonsense = 1\n")
    assert (
        told(guide())["calibrate"].state == "ready"
        and "width_px" in told(guide())["calibrate"].found
    )
    Path("camera.toml").write_text(CAMERA)
    steps = told(guide(), heard())
    assert "640x480" in steps["calibrate"].found
    assert [steps[name].state for name in ("calibrate", "record", "build")] == [
        "done",
        "done",
        "ready",
    ]
    assert steps["build"].ways[0].command == (
        "blimp map build recordings/board.mcap --camera camera.toml --out maps/NAME"
    )
    own_map(registered=False)
    register = told(guide())["register"]
    assert "as floorplan.png" in register.ways[0].text and register.choices == []
    Path("floorplan.png").touch()
    steps = told(guide(), heard())
    assert steps["register"].choices == ["hall"]
    assert steps["build"].state == "done" and "WHOLE: all 125 images" in steps["build"].found
    assert steps["register"].state == "ready" and steps["fly"].state == "waiting"
    assert steps["register"].ways[0].command == (
        "blimp map register maps/hall --page --plan floorplan.png"
    )
    assert first_way(guide().steps(None)) == steps["register"].ways[0].command
    shutil.rmtree("maps")
    own_map()
    steps = told(guide(), heard())
    assert "to 0.6 cm" in steps["register"].found and steps["fly"].state == "ready"
    assert steps["fly"].ways[0].command == (
        "blimp serve --lan --map maps/hall --set map.camera=camera.toml"
    )
    assert states(guide(), heard({"state": "TRACKING", "map": "atrium"}))[-2] == "ready"
    tracked = states(guide(), heard({"state": "TRACKING", "map": "hall"}))
    assert tracked == [*["done"] * 6, "waiting"]
    assert first_way(guide().steps(heard({"state": "TRACKING", "map": "hall"}))) == ""


def test_with_a_map_of_a_phones_video_the_payload_needs_a_lens_of_its_own() -> None:
    Path("Walk 1.MP4").touch()
    steps = told(guide())
    assert steps["record"].state == "done" and steps["build"].state == "ready"
    assert steps["build"].ways[1].command == "blimp map build 'Walk 1.MP4' --out maps/NAME"
    assert steps["build"].choices == ["Walk 1.MP4"]
    Path("camera.toml").write_text(CAMERA)  # the payload's, and not the phone's
    words = guide().job({"station": {"demo": False}, "payloads": {}}, "build", "Walk 1.MP4", "hall")
    assert words == ["blimp", "map", "build", "Walk 1.MP4", "--out", "maps/hall"]
    Path("camera.toml").unlink()
    own_map(inputs="Walk 1.MP4")
    fly = told(guide(), heard())["fly"]
    assert fly.state == "waiting" and "another camera" in fly.found
    Path("camera.toml").write_text(CAMERA)
    fly = told(guide(), heard())["fly"]
    assert fly.state == "ready" and fly.ways[0].command.endswith("--set map.camera=camera.toml")
    assert told(guide())["fly"].found == "needs a payload that is heard"


def test_a_flight_in_the_map_may_extend_it() -> None:
    own_map()
    record("elsewhere.mcap", "barn")
    assert told(guide())["extend"].state == "waiting"
    record("flight.mcap", "hall")
    extend = told(guide())["extend"]
    assert extend.state == "done" and extend.choices == ["flight.mcap"]
    assert "not extended yet; recorded flights in it: 1" in extend.found
    command = "blimp map extend maps/hall recordings/flight.mcap --out maps/"
    assert extend.ways[0].command == command + "NAME"
    document = {"station": {"demo": False, "loopback": True}, "payloads": {}}
    words = guide().job(document, "extend", "flight.mcap", "hall-2")
    assert shlex.join(words) == command + "hall-2"
    own_map("hall-2")
    Path("camera.toml").write_text(CAMERA)
    record("again.mcap", "hall", "hall-2")  # it grows further where it was flown last
    words = guide().job(document, "extend", "again.mcap", "hall-3")
    assert shlex.join(words) == (
        "blimp map extend maps/hall-2 recordings/again.mcap --camera camera.toml --out maps/hall-3"
    )
    for choice, name in (("flight.mcap", "hall"), ("flight.mcap", ""), ("elsewhere.mcap", "b")):
        with pytest.raises(GroundStationError):
            guide().job(document, "extend", choice, name)


def test_every_command_that_it_names_is_one() -> None:
    """Also with the odd names that a shell would take apart."""
    Path("board.toml").touch()
    Path("it's; a walk.mov").touch()
    own_map("h")
    own_map("i", registered=False)
    record("flight.mcap", "i")
    for step in (*guide().steps(None), *guide(camera="a b.toml").steps(heard())):
        for text in (step.check, *(way.command for way in step.ways)):
            program, *words = shlex.split(text.removeprefix("sudo ")) or ["", ""]
            if program == "blimp":
                blimp().parse_args(words)


def test_init_shows_what_the_page_does(served: Any, capsys: Any, monkeypatch: Any) -> None:
    import urllib.request
    from io import BytesIO

    client = served[0]
    answer = client.get("/api/guide").json()
    assert [step["name"] for step in answer["steps"]] == [
        "payload", "calibrate", "record", "build", "register", "fly", "extend",
    ]  # fmt: skip
    assert answer["steps"][0]["state"] == "done" and "30 frames" in answer["steps"][0]["found"]
    monkeypatch.setattr(
        urllib.request.OpenerDirector, "open", lambda *_, **__: BytesIO(json.dumps(answer).encode())
    )
    assert cli.main(["init", "--json", "steps.json"]) == 0
    assert json.loads(Path("steps.json").read_text())["steps"] == answer["steps"]
    said = capsys.readouterr().out
    assert answer["folder"] in said and answer["steps"][0]["found"] in said
    assert said.splitlines()[-1] == "next: blimp calibrate board --out board.pdf"


@pytest.mark.parametrize("answer", [b"", b"[]", b"{}", b'{"folder": "x", "steps": [{"name": 1}]}'])
def test_another_program_on_the_port_is_not_believed(
    answer: bytes, capsys: Any, monkeypatch: Any
) -> None:
    import urllib.request
    from io import BytesIO

    monkeypatch.setattr(urllib.request.OpenerDirector, "open", lambda *_, **__: BytesIO(answer))
    assert cli.main(["init"]) == 0
    said = capsys.readouterr().out
    assert said.startswith("no station runs") and said.endswith("next: blimp keys init\n")


def test_maps_that_cannot_be_read_and_the_sample_are_not_ones_own(served: Any) -> None:
    Path("maps/broken").mkdir(parents=True)
    Path("maps/broken/map.toml").write_text("format = 99\n")
    assert told(guide())["build"].found == "needs a recording or a video"
