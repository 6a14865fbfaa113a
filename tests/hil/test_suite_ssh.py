"""`ssh:` against a real sshd on loopback: a flight, one transfer of a recording, honest refusals.

That machine is no card: the firmware runs from this checkout's folder, and nothing is restored.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import suite
from loopback_sshd import LIMIT_S, SSHD, LoopbackSshd
from payloads import board
from payloads.ssh import Plain, SshPayload
from payloads.target import SshError, Target

from ground_station.errors import InputError

CHECKOUT = Path(__file__).parents[2]
SAMPLE = CHECKOUT / "maps" / "atrium"

needs_sshd = pytest.mark.skipif(
    SSHD is None or shutil.which("ssh") is None, reason="openssh-server or its client is missing"
)


@pytest.fixture(scope="module")
def sshd(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LoopbackSshd]:
    with LoopbackSshd(tmp_path_factory.mktemp("sshd") / "run") as made:
        yield made


def target_of(sshd: LoopbackSshd) -> Target:
    return Target(
        "127.0.0.1", sshd.user, sshd.port, sshd.identity, sshd.known_hosts,
        sshd.folder / "ssh_config",
    )  # fmt: skip


def reached(sshd: LoopbackSshd, recordings: Path) -> SshPayload:
    plain = Plain(str(CHECKOUT), sys.executable, str(recordings))
    return SshPayload(target_of(sshd), plain=plain)


def config_of(recording: Path, port: int, seconds: float = 2.0) -> dict[str, object]:
    """As a replay makes it, of a payload that nobody listens to."""
    return {
        "payload_id": "replay",
        "camera": {
            "uri": f"replay:{recording}?rate_hz=5&duration_s={seconds:g}",
            "width_px": 640,
            "height_px": 480,
        },
        "gate": {},
        "link": {"port": port},
        "telemetry": {"connect": [], "enabled": False},
        "wifi": {"interface": ""},
    }


@needs_sshd
def test_a_flight_is_judged_and_its_recording_sent_once(sshd: LoopbackSshd, tmp_path: Path) -> None:
    recordings = tmp_path / "there"
    payload = reached(sshd, recordings)
    assert not payload.is_card and payload.ground_host == "127.0.0.1"
    recording = SAMPLE / "flight.mcap"
    ends = []
    for _ in range(2):
        with payload.payload(config_of(recording, 9), tmp_path) as flight:
            until_s = time.monotonic() + LIMIT_S
            while flight.running():
                flight.check()
                assert time.monotonic() < until_s
                time.sleep(0.05)
            flight.check()
        ends.append(flight.usage)
        log = (tmp_path / "firmware.log").read_text()
        assert "no blimp-payload.service on this machine" in log
        assert "frames: 10 captured" in log
    assert payload.sent == 1
    assert reached(sshd, recordings).send(recording) and payload.sent == 1
    digest = hashlib.sha256(recording.read_bytes()).hexdigest()
    assert [path.name for path in recordings.glob("*.mcap")] == [f"{digest}.mcap"]
    assert all(end["memory_bytes"] > 10e6 and end["cpu_ns"] > 0 for end in ends)


@needs_sshd
def test_the_firmware_ends_with_the_line_to_it(sshd: LoopbackSshd, tmp_path: Path) -> None:
    """The ground's ssh is killed, as a broken link does it: what flew there does not fly on."""
    payload = reached(sshd, tmp_path / "there")
    config = config_of(SAMPLE / "flight.mcap", 9, seconds=30)
    with payload.payload(config, tmp_path) as flight:
        found = firmware_of(str(tmp_path / "there"))
        assert len(found) == 1
        flight._process.send_signal(signal.SIGKILL)
        until_s = time.monotonic() + LIMIT_S
        while firmware_of(str(tmp_path / "there")):
            assert time.monotonic() < until_s
            time.sleep(0.1)
        assert not flight.running()
        with pytest.raises(SshError, match="ssh ended with status -9"):
            flight.check()


def firmware_of(text: str) -> list[int]:
    """Processes of the firmware whose command line holds this."""
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                words = (folder / "cmdline").read_bytes().decode(errors="replace").split("\0")
            except OSError:
                continue
            if words[1:3] == ["-m", "pi_firmware"] and text in " ".join(words):
                found.append(int(folder.name))
    return found


@needs_sshd
def test_the_suite_flies_over_ssh(
    sshd: LoopbackSshd, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    case = tmp_path / "short.toml"
    case.write_text(
        f'title = "over SSH"\nrecording = "{SAMPLE / "flight.mcap"}"\nmap = "{SAMPLE}"\n'
        "rate_hz = 5.0\nstart_s = 2.0\nduration_s = 2.0\n"
        "[bounds]\nlost_max = 0.0\n"
    )
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setattr(suite.signal, "signal", lambda *_: None)  # the test runner's own stay
    words = [case, "--payload", f"ssh:{sshd.user}@127.0.0.1:{sshd.port}", "--identity",
             sshd.identity, "--known-hosts", sshd.known_hosts, "--ssh-config",
             sshd.folder / "ssh_config", "--folder", CHECKOUT, "--python", sys.executable,
             "--out", tmp_path / "out"]  # fmt: skip
    assert suite.main([str(word) for word in words]) == 0
    assert "frames: 10 captured" in (tmp_path / "out/short/firmware.log").read_text()
    told = json.loads((tmp_path / "out/suite.json").read_text())
    assert told["passed"] and "no card" in told["payload"]
    assert told["cases"][0]["outcome"]["accounts"]["captured"] == 10


@needs_sshd
def test_a_host_key_that_is_not_known_is_refused(sshd: LoopbackSshd, tmp_path: Path) -> None:
    (tmp_path / "none").write_text("")
    stranger = Target(
        "127.0.0.1", sshd.user, sshd.port, sshd.identity, tmp_path / "none",
        sshd.folder / "ssh_config",
    )  # fmt: skip
    with pytest.raises(SshError, match="its host key is not known") as refused:
        SshPayload(stranger)
    assert "\n" not in str(refused.value)
    assert (tmp_path / "none").read_text() == ""


@needs_sshd
def test_a_firmware_that_refuses_says_so_here(sshd: LoopbackSshd, tmp_path: Path) -> None:
    payload = reached(sshd, tmp_path / "there")
    config = config_of(SAMPLE / "flight.mcap", 9)
    with (
        pytest.raises(SshError, match=r"status 2: .*bitrate_kbps"),
        payload.payload({**config, "encoder": {"bitrate_kbps": 1}}, tmp_path),
    ):
        pass


def test_a_target_that_is_none_is_refused() -> None:
    for text in ("", "-oProxyCommand=x", "a@-b", "host:99999", "host:0", "a b", "u@h:1:2"):
        with pytest.raises(InputError, match="expected ssh:user@host"):
            Target.parse(text)
    made = Target.parse("pilot@blimp-1.local:2222")
    assert (made.user, made.host, made.port) == ("pilot", "blimp-1.local", 2222)
    assert Target.parse("[fe80::1%wlan0]").host == "fe80::1%wlan0"


def test_a_card_flies_its_own_service_with_what_is_another() -> None:
    """systemd reads the drop-in's words as they were meant, whatever signs are in them."""
    text = board.drop_in(["camera.uri=replay:/data/hil/a.mcap?rate_hz=5&x=50%", 'a.b=["$c\\\\"]'])
    lines = text.splitlines()
    assert lines[0] == "[Service]" and lines[1] == "ExecStart="
    words = '"--set" "camera.uri=replay:/data/hil/a.mcap?rate_hz=5&x=50%%" "--set"'
    assert lines[2].startswith('ExecStart="/usr/bin/python3" "-P" "-m" "deploy.board.start" ')
    assert words in lines[2] and lines[2].endswith(' "a.b=[\\"$$c\\\\\\\\\\"]"')
    assert "Restart=no" in lines
    with pytest.raises(board.BoardError, match="unprintable"):
        board.quoted("a\nb")


def test_a_recording_that_does_not_fit_or_comes_damaged_is_not_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = {"recordings": str(tmp_path), "sha256": "0" * 64, "size": 5}
    read, write = os.pipe()
    os.write(write, b"12345")
    os.close(write)
    keep = os.dup(0)
    try:
        os.dup2(read, 0)
        with pytest.raises(board.BoardError, match="another digest"):
            board.receive(spec)
    finally:
        os.dup2(keep, 0)
        os.close(keep)
        os.close(read)
    monkeypatch.setattr(board, "_free", lambda folder: 1000)
    with pytest.raises(board.BoardError, match="needed are 0 MB and 34 MB"):
        board.receive(spec)
    assert not [path for path in tmp_path.iterdir() if path.name != ".lock"]
