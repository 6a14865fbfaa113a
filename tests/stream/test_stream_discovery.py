"""A payload finds its ground station on the network that it is told of, and on no other."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from namespaces import unshared

from ground_station.keys.authority import Authority
from ground_station.stream.telemetry import TelemetryListener
from pi_firmware.wire import scouting
from pi_firmware.wire.errors import TelemetryError
from pi_firmware.wire.telemetry import open_session

HOSTS = Path(__file__).with_name("two_hosts.py")


@pytest.fixture
def namespaces() -> list[str]:
    """The command that runs another one in network namespaces of its own."""
    return unshared()


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    return make_authority(tmp_path / "ours")


def make_authority(folder: Path) -> Authority:
    made = Authority.create(folder)
    made.add("ground", "main")
    made.add("payload", "blimp-1")
    return made


def test_a_payload_finds_the_ground_it_trusts_on_a_network_that_comes_up_late(
    namespaces: list[str], authority: Authority, tmp_path: Path
) -> None:
    """The payload's program is told of nobody: it finds telemetry and where its video goes.

    Two ground stations answer; the one of another authority never learns of the payload.
    """
    foreign = make_authority(tmp_path / "foreign")
    hosts = [*namespaces, sys.executable, str(HOSTS), str(authority.folder), str(foreign.folder)]
    run = subprocess.run(hosts, capture_output=True, text=True, timeout=180)
    assert run.returncode == 0, run.stderr
    heard = {"link told": True, "video": True}
    assert json.loads(run.stdout) == {"first": heard, "again": heard, "stranger": []}


LO = """
from ground_station.stream.telemetry import TelemetryListener
from pi_firmware.settings import TelemetrySettings
from pi_firmware.telemetry import Telemetry
with TelemetryListener(["tcp/127.0.0.1:0"], discoverable="lo") as listener:
    telemetry = Telemetry("blimp-1", TelemetrySettings(connect=[], discover="lo"))
    found = listener.wait("blimp-1", lambda s: s.alive, 60.0)
    print(found is not None)
    telemetry.close()
"""


def test_on_loopback_it_needs_no_certificate(namespaces: list[str]) -> None:
    script = 'ip link set lo up multicast on; exec "$0" -c "$1"'
    run = subprocess.run(
        [*namespaces, "sh", "-c", script, sys.executable, LO],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert run.stdout == "True\n", run.stderr


def test_elsewhere_nobody_is_looked_for_without_a_certificate() -> None:
    cases: tuple[dict[str, Any], ...] = ({"scout": "wlan0"}, {"discoverable": "wlan0"})
    for options in cases:
        with pytest.raises(TelemetryError, match="'wlan0': without certificates only 'lo'"):
            open_session(listen=["tcp/127.0.0.1:0"], **options)


def test_an_interface_that_is_not_there_is_named(
    authority: Authority, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scouting, "INTERFACE_WAIT_S", 0.0)
    certificates = authority.of("payload.blimp-1")
    for name in ("nosuch0", "x" * 40):
        with pytest.raises(TelemetryError, match=rf"'{name}': no such interface \(there are: .*lo"):
            open_session(certificates=certificates, scout=name)


def test_an_interface_without_an_address_does_not_hold_a_flight_up(
    authority: Authority, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is flown without a ground station, and one that comes needs a new session."""
    addresses: dict[str, str] = {}
    monkeypatch.setattr(scouting, "INTERFACE_WAIT_S", 0.0)
    monkeypatch.setattr(scouting, "interface_address", addresses.get)
    certificates = authority.of("payload.blimp-1")
    session = open_session(certificates=certificates, scout="lo")
    assert not session.scouting and not session.outdated
    addresses["lo"] = "127.0.0.1"
    assert session.outdated
    session.close()
    session = open_session(certificates=certificates, scout="lo")
    assert session.scouting == "127.0.0.1" and not session.outdated
    addresses.clear()  # gone for a moment: the same one may come back
    assert not session.outdated
    addresses["lo"] = "127.0.0.2"
    assert session.outdated
    session.close()
    session = open_session(certificates=certificates)
    assert not session.outdated
    session.close()


def test_a_ground_that_is_to_be_found_must_listen(authority: Authority) -> None:
    with pytest.raises(TelemetryError, match="an endpoint to listen on is needed"):
        TelemetryListener([], certificates=authority.of("ground.main"), discoverable="lo")
