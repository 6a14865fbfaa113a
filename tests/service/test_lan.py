"""A station on a network: what `--lan` sets, and the one line of each refusal."""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest

from ground_station import cli
from ground_station.errors import InputError
from ground_station.keys.authority import Authority
from ground_station.service import lan, settings
from ground_station.service.settings import StationSettings

BLIMP = Path(sys.executable).with_name("blimp")


@pytest.fixture
def data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The user's folder, in which there are no keys yet; two networks."""
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    monkeypatch.setattr(lan, "interfaces", lambda: {"wlan0": "10.0.0.1", "eth0": "10.1.0.1"})
    return tmp_path / "blimp/keys"


def test_without_keys_it_names_the_commands_that_make_them(data: Path) -> None:
    with pytest.raises(InputError, match="blimp keys init && blimp keys ground main && blimp keys"):
        lan.on(StationSettings(), "wlan0")
    Authority.create(data).add("ground", "hall")
    with pytest.raises(InputError, match=r"them: blimp keys ground main \(keys are here of: hall;"):
        lan.on(StationSettings(), "wlan0")
    hall = StationSettings(name="hall")
    assert lan.on(hall, "wlan0").telemetry.certificates == str(data / "ground/hall")
    other = settings.load(None, [f"telemetry.certificates={data / 'ground/hall'}",
                                 'telemetry.listen=["tls/10.0.0.1:7000"]'])  # fmt: skip
    with pytest.raises(InputError, match=r"is of ground\.hall, and this station is ground\.main"):
        lan.on(other, "wlan0")


def test_it_takes_the_only_network_and_asks_which_of_several(
    data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Authority.create(data).add("ground", "main")
    for name, words in (("", r"name one of wlan0 \(10.0.0.1\), eth0 \("), ("lo", "wlan0, eth0")):
        with pytest.raises(InputError, match=words):
            lan.on(StationSettings(), name)
    monkeypatch.setattr(lan, "interfaces", lambda: {"wlan0": "10.0.0.1"})
    assert lan.on(StationSettings()).telemetry.discoverable == "wlan0"
    monkeypatch.setattr(lan, "interfaces", dict)
    with pytest.raises(InputError, match="no interface of this machine"):
        lan.on(StationSettings())


def test_it_is_the_block_of_station_toml(data: Path) -> None:
    """What `--lan` sets is what that block says; ports and all else stay."""
    Authority.create(data).add("ground", "main")
    block = "\n".join(re.findall(r"^#   (.+)$", settings.SHIPPED.read_text(), re.MULTILINE))
    document = tomllib.loads(block)
    document["telemetry"]["certificates"] = str(data / "ground/main")
    wanted = settings.from_mapping(document, StationSettings)
    assert lan.on(StationSettings(), "wlan0") == wanted
    moved = settings.load(None, ["video.port=5700", 'telemetry.listen=["tcp/127.0.0.1:7500"]'])
    found = lan.on(moved, "wlan0")
    assert (found.video.port, found.telemetry.listen) == (5700, ["tls/0.0.0.0:7500"])


def test_it_tells_what_a_payload_needs(data: Path) -> None:
    authority = Authority.create(data)
    authority.add("ground", "main")
    assert "hears nobody yet: blimp keys payload" in lan.summary(lan.on(StationSettings(), "wlan0"))
    authority.add("payload", "blimp-7")
    said = lan.summary(lan.on(StationSettings(), "wlan0"))
    for words in ("hears the payloads: blimp-7", "PAYLOAD=blimp-7", "video udp 5600 (SRTP)"):
        assert words in said


def test_under_sudo_the_keys_are_those_of_the_person(
    data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home = data.parent / "home"
    folder = Authority.create(home / ".local/share/blimp/keys").add("ground", "main")
    monkeypatch.setattr(lan.os, "geteuid", lambda: 0)
    monkeypatch.setattr(lan.pwd, "getpwnam", lambda _: SimpleNamespace(pw_dir=str(home)))
    monkeypatch.setenv("SUDO_USER", "somebody")
    assert lan.on(StationSettings(), "wlan0").telemetry.certificates == str(folder)


def test_loopback_is_no_network() -> None:
    assert "lo" not in lan.interfaces()


def test_a_recording_without_the_service_hears_what_the_service_would(
    data: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Started(Exception):
        pass

    def intake(loaded: StationSettings, *_: object, **__: object) -> None:
        assert loaded.telemetry.listen == ["tls/0.0.0.0:7447"] and loaded.video.host == "0.0.0.0"
        assert loaded.recording.folder == "flights"
        raise Started

    Authority.create(data).add("ground", "main")
    monkeypatch.setattr("ground_station.service.intake.process.Intake", intake)
    with pytest.raises(Started):
        cli.main(["record", "--lan", "wlan0", "--out", "flights"])
    assert "telemetry tcp 7447 (TLS)" in capsys.readouterr().out
