"""`blimp serve --check` refuses what `blimp serve` refuses at its start, in the same line."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from pathlib import Path

import pytest

from ground_station import cli
from ground_station.keys.authority import Authority
from ground_station.service import ending
from ground_station.service.bus import Router
from ground_station.service.intake import __main__ as intake
from ground_station.service.settings import Run, load, write_run
from ground_station.service.web import __main__ as web
from pi_firmware.wire.errors import BlimpError

ROOT = Path(__file__).parents[2]
TLS = 'telemetry.listen=["tls/127.0.0.1:0"]'
PORTS = ("video.port=5699", "http.port=0", "foxglove.port=0")


@pytest.fixture(autouse=True)
def at_home(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    for module in (ending, intake):  # signals stay those of the tests
        monkeypatch.setattr(module, "ending", lambda _: threading.Event())


def serve(*words: str, settings: tuple[str, ...] = ()) -> int:
    """The command, to its end."""
    return cli.main(["serve", *words, *(f"--set={setting}" for setting in settings)])


def test_what_is_good_is_said(capfd: pytest.CaptureFixture[str]) -> None:
    assert serve("--check") == 0
    said = capfd.readouterr()
    assert said.err == "" and said.out.splitlines()[0] == "configuration is good"


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (("map.folder=tests",), "tests: a folder without a map (map.toml); blimp map build"),
        (("map.folder=nosuch",), "nosuch: there is no such map; blimp map build INPUT --out"),
        (("map.camera=/nosuch.toml",), "/nosuch.toml: No such file or directory"),
        (("telemetry.certificates=/nosuch", TLS), "/nosuch"),
        (("telemetry.discoverable=wlan9",), "discovery on 'wlan9': without certificates only 'lo'"),
        (("http.host=0.0.0.0",), "http.host is '0.0.0.0', which others reach: it needs"),
        (("http.token_file=/nosuch",), "/nosuch"),
    ],
)
def test_both_refuse_it(
    settings: tuple[str, ...], said: str, capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert serve("--check", settings=settings) == 2
    checked = capfd.readouterr().err
    assert said in checked and checked.count("\n") == 1
    if settings[0].startswith("map.folder"):
        assert serve(settings=settings) == 2
        assert capfd.readouterr().err == checked
        return
    # Of its processes, whose refusal ends the service.
    write_run(tmp_path, Run(load(None, (*PORTS, *settings))))
    with contextlib.closing(Router(tmp_path)), pytest.raises(BlimpError) as refused:
        if settings[0].startswith("http"):
            asyncio.run(web._serve(tmp_path))
        else:
            intake.serve(str(tmp_path))
    assert said in str(refused.value)


def test_keys_and_the_interface_are_looked_at(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    keys = Authority.create(tmp_path / "keys").add("ground", "main")
    certified = (f"telemetry.certificates={keys}", TLS)
    assert serve("--check", settings=certified) == 0
    assert serve("--check", settings=(*certified, "telemetry.discoverable=wlan9")) == 2
    missing = "telemetry.discoverable is 'wlan9': no such interface (there are: "
    assert missing in capfd.readouterr().err
