"""A case file: what is refused, by name and with the range, and what holds for a payload kind."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cases_stand as stand
import pytest
import tomli_w

from ground_station.replay.cases.case import Case, load_case
from pi_firmware.wire.errors import BlimpError


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A place with a recording, a map and a survey."""
    stand.recording(tmp_path / "flight.mcap")
    (tmp_path / "hall").mkdir()
    (tmp_path / "hall" / "map.toml").write_text("")
    (tmp_path / "survey.txt").write_text("5.0 1 2 1.5 0 0 0 1\n")
    return tmp_path


def load(folder: Path, **keys: Any) -> Case:
    usual = {"title": "a loop", "recording": "flight.mcap", "map": "hall"}
    path = folder / "loop.toml"
    path.write_text(tomli_w.dumps({**usual, **keys}))
    return load_case(path)


def test_a_case_without_more_has_the_defaults_and_paths_beside_it(folder: Path) -> None:
    case = load(folder)
    assert (case.name, case.preset, case.init, case.rate_hz) == ("loop", "default", "none", 30.0)
    assert case.recording_path == folder / "flight.mcap" and case.map_path == folder / "hall"
    assert case.truth.kind == "none" and case.truth_path is None
    assert case.payload.kinds == ["process", "image", "ssh"] and case.link.kind == "loopback"
    assert all(value in (None, False) for value in vars(case.limits("process")).values())


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ({"titel": "x"}, "unknown key 'titel'"),
        ({"link": {"kind": "proxy", "los": 0.1}}, "unknown key 'link.los'"),
        ({"bounds": {"image": {"coverage": 0.1}}}, "unknown key 'bounds.image.coverage'"),
        ({"title": ""}, "'title' is ''"),
        ({"title": "a\nb"}, "'title' is 'a\\nb'"),
        ({"recording": "gone.mcap"}, "'recording'"),
        ({"recording": "a" * 5000}, "'recording'"),
        ({"recording": "a\0b"}, "'recording'"),
        ({"map": "flight.mcap"}, "'map'"),
        ({"rate_hz": float("nan")}, "'rate_hz' must be a finite number"),
        ({"rate_hz": 0}, "'rate_hz' is 0.0; allowed: 1.0 to 120.0 Hz"),
        ({"rate_hz": True}, "'rate_hz' must be a number, not True"),
        ({"start_s": -1.0}, "'start_s' is -1.0; allowed: 0.0 to"),
        ({"preset": "best"}, "'preset' is 'best'; allowed: 'default', 'thesis'"),
        ({"preset": "thesis"}, "'init' is 'none'"),
        ({"init": "gone.txt"}, "'init'"),
        ({"payload": {"kinds": []}}, "'payload.kinds' is empty"),
        ({"payload": {"kinds": ["drone"]}}, "'payload.kinds'[0] is 'drone'"),
        ({"payload": {"settings": ["bitrate 800"]}}, "'payload.settings[0]' is 'bitrate 800'"),
        ({"payload": {"settings": ["supervision.reboot_command=['halt']"]}}, "cannot set"),
        ({"payload": {"settings": ["battery.shutdown_command=['halt']"]}}, "cannot set"),
        ({"kinds": {"ssh": {"settings": ["link.host=1.2.3.4"]}}}, "'kinds.ssh.settings[0]'"),
        ({"kinds": {"image": {"rate_hz": 500.0}}}, "'kinds.image.rate_hz' is 500.0; allowed: 1.0"),
        ({"link": {"kind": "radio"}}, "'link.kind' is 'radio'; allowed: 'loopback'"),
        ({"link": {"loss": 0.1}}, "'link.loss' is set, but 'link.kind' is 'loopback'"),
        ({"link": {"kind": "proxy", "loss": 1.5}}, "'link.loss' is 1.5; allowed: 0.0 to 1.0"),
        ({"link": {"kind": "proxy", "seed": -1}}, "'link.seed' is -1"),
        ({"link": {"kind": "proxy", "outages": [[1.0]]}}, "'link.outages[0]' has 1 numbers"),
        ({"link": {"kind": "proxy", "outages": [[1.0, 0.0]]}}, "lasts 0 s; allowed: more than 0"),
        ({"link": {"kind": "proxy", "outages": [[3.0, 2.0], [4.0, 1.0]]}}, "from 5 s on"),
        ({"link": {"kind": "proxy", "outages": [[-1.0, 2.0]]}}, "'link.outages'[0][0] is -1.0"),
        ({"truth": {"kind": "survey"}}, "the key 'truth.file' is missing"),
        ({"truth": {"kind": "survey", "file": "no.txt"}}, "'truth.file'"),
        ({"truth": {"file": "survey.txt"}}, "'truth.file' is set, but 'truth.kind' is 'none'"),
        ({"truth": {"kind": "recording", "topic": "truth"}}, "a topic begins with /"),
        ({"bounds": {"coverage_min": 1.2}}, "'bounds.coverage_min' is 1.2; allowed: 0.0 to 1.0"),
        ({"bounds": {"position_max_m": -0.5}}, "allowed: 0.0 to inf m"),
        ({"bounds": {"latency_p50_ms_max": float("inf")}}, "must be a finite number"),
        ({"bounds": {"battery_V_min": 4.0, "battery_V_max": 3.0}}, "'bounds.battery_V_min' is 4 V"),
        ({"bounds": {"identical": True}}, "allowed only where 'stepped' is true"),
        ({"bounds": {"image": {"drop": ["speed"]}}}, "'bounds.image.drop'[0] is 'speed'"),
    ],
)
def test_what_does_not_fit_is_refused_by_name(
    folder: Path, keys: dict[str, Any], says: str
) -> None:
    with pytest.raises(BlimpError) as error:
        load(folder, **keys)
    text = str(error.value)
    assert says in text and "\n" not in text
    assert text.startswith(str(folder / "loop.toml"))


def test_a_file_that_is_no_toml_or_not_there_is_refused(folder: Path) -> None:
    for content in (b"title = ", b"\xff\xfe", b"a = " + b"[" * 5000):
        (folder / "bad.toml").write_bytes(content)
        with pytest.raises(BlimpError, match=r"^[^\n]*bad\.toml: not .*TOML"):
            load_case(folder / "bad.toml")
    with pytest.raises(BlimpError, match=r"none\.toml: No such file"):
        load_case(folder / "none.toml")


def test_an_accepted_run_may_be_still_to_come(folder: Path) -> None:
    case = load(folder, truth={"kind": "golden", "file": "loop.golden.txt"})
    assert case.truth_path == folder / "loop.golden.txt"


def test_a_payload_kind_has_its_own_bounds_in_place_of_the_others(folder: Path) -> None:
    case = load(
        folder,
        bounds={
            "coverage_min": 0.9,
            "latency_p50_ms_max": 50.0,
            "lost_max": 0.1,
            "image": {"coverage_min": 0.5, "drop": ["latency_p50_ms_max"]},
        },
    )
    process, image, ssh = (case.limits(kind) for kind in ("process", "image", "ssh"))
    assert (process.coverage_min, process.latency_p50_ms_max) == (0.9, 50.0) and process == ssh
    assert (image.coverage_min, image.latency_p50_ms_max, image.lost_max) == (0.5, None, 0.1)


def test_a_bound_of_zero_is_a_bound(folder: Path) -> None:
    case = load(folder, bounds={"lost_max": 0.5, "image": {"lost_max": 0.0}})
    assert case.limits("image").lost_max == 0.0


def test_a_payload_kind_flies_what_it_bears(folder: Path) -> None:
    case = load(
        folder,
        start_s=2.0,
        payload={"settings": ["encoder.bitrate_kbps=800"]},
        kinds={"image": {"rate_hz": 5.0, "start_s": 0.0, "settings": ["gate.enabled=false"]}},
    )
    image, process = case.flown("image"), case.flown("process")
    assert (image.rate_hz, image.start_s, image.duration_s) == (5.0, 0.0, 0.0)
    assert image.settings == ["encoder.bitrate_kbps=800", "gate.enabled=false"]
    assert (process.rate_hz, process.start_s, process.settings) == (
        30.0, 2.0, ["encoder.bitrate_kbps=800"],
    )  # fmt: skip
