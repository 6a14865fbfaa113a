"""`blimp doctor` as one calls it: the table, JSON, the exit status, and who is heard."""

import json
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from ground_station import cli
from ground_station.doctor import ROOT, command, running, software
from ground_station.doctor.findings import OK, PROBLEM, Check
from ground_station.service.settings import StationSettings, TelemetrySettings
from pi_firmware.wire import keys, telemetry


def free_port(kind: int) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def configuration(folder: Path, more: str = "") -> Path:
    path = folder / "station.toml"
    path.write_text(
        f"""
{more}
[map]
folder = "{ROOT / "maps" / "atrium"}"
[video]
port = {free_port(socket.SOCK_DGRAM)}
[telemetry]
listen = ["tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"]
[http]
port = 0
[foxglove]
port = 0
[recording]
folder = "{folder / "recordings"}"
min_free_MB = 0
max_file_MB = 1
"""
    )
    return path


def doctor(*arguments: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    words = [sys.executable, "-m", "ground_station.cli", "doctor", *map(str, arguments)]
    return subprocess.run(
        words,
        cwd=cwd,
        env={"PATH": "/usr/bin:/bin", "PYTHONPATH": str(ROOT), "HOME": str(cwd)},
        capture_output=True,
        text=True,
        timeout=120,
    )


def test_a_machine_that_is_well(tmp_path: Path) -> None:
    out = tmp_path / "doctor.json"
    run = doctor("--config", configuration(tmp_path), "--json", out, cwd=tmp_path)
    document = json.loads(out.read_text())
    problems = [f for f in document["findings"] if f["level"] == PROBLEM]
    assert (run.returncode, problems, run.stderr) == (0, [], "")
    assert document["counts"][PROBLEM] == 0
    levels = {finding["name"]: finding["level"] for finding in document["findings"]}
    assert levels.keys() >= {"map", "clock", "disk", "firewall", "payloads"}
    # As the lock says, and able to encode and decode.
    assert all(levels[name] == OK for name in ("python", "packages", "gstreamer", "encoder"))
    assert all(finding["fix"] for finding in document["findings"] if finding["level"] != OK)
    assert "\x1b" not in run.stdout
    assert not (tmp_path / "recordings").exists()


@pytest.fixture
def here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str]]:
    """Runs the command in this process, of the machine's own checks only the quickest one."""
    monkeypatch.chdir(tmp_path)
    for name in ("HOME", "XDG_DATA_HOME"):
        monkeypatch.setenv(name, str(tmp_path))
    monkeypatch.setattr(command, "of_machine", lambda: [Check("python", software.python)])

    def run(*arguments: object) -> tuple[int, str]:
        return cli.main(["doctor", *map(str, arguments)]), capsys.readouterr().out

    return run


def test_a_problem_is_status_1_and_says_how_to_mend_it(
    tmp_path: Path, here: Callable[..., tuple[int, str]]
) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as held:
        held.bind(("127.0.0.1", 0))
        port = held.getsockname()[1]
        status, said = here("--config", configuration(tmp_path), "--set", f"video.port={port}")
    assert status == 1
    lines = said.splitlines()
    at = next(i for i, line in enumerate(lines) if line.startswith(f"port {port}/udp"))
    assert "problem" in lines[at]
    assert any("->" in line for line in lines[at + 1 : at + 4])


def test_a_configuration_that_is_refused_is_the_first_finding(
    tmp_path: Path, here: Callable[..., tuple[int, str]]
) -> None:
    status, said = here("--config", configuration(tmp_path, "nmae = 'hall'"))
    assert status == 1 and "nmae" in "".join(said.splitlines()[:2])
    assert "python" in said and "port " not in said


def test_a_network_without_certificates_is_the_first_finding(
    tmp_path: Path, here: Callable[..., tuple[int, str]]
) -> None:
    status, said = here("--lan", "--config", configuration(tmp_path))
    assert status == 1 and "blimp keys ground main" in " ".join(said.split())


def station(port: int) -> StationSettings:
    return StationSettings(telemetry=TelemetrySettings(listen=[f"tcp/127.0.0.1:{port}"]))


def heard(port: int, key: str, message: bytes) -> str:
    """What the doctor says while a payload is alive and repeats a message."""
    session = telemetry.open_session(connect=[f"tcp/127.0.0.1:{port}"])
    ended = threading.Event()

    def speak() -> None:
        while not ended.wait(0.05):
            session.zenoh.put(key, message)

    thread = threading.Thread(target=speak)
    token = session.zenoh.liveliness().declare_token(keys.key("blimp-7", keys.ALIVE))
    thread.start()
    try:
        for _ in range(5):  # the peer tries again in its own time
            found = running.payloads(station(port), listen_s=3.0)
            if "blimp-7" in found.found:
                break
        return f"{found.level}: {found.found}"
    finally:
        ended.set()
        thread.join()
        token.undeclare()
        session.close()


def test_a_payload_is_heard_and_one_of_another_version_is_a_problem() -> None:
    port = free_port(socket.SOCK_STREAM)
    good = json.dumps({"schema": "blimp.health/1.0", "time_ns": 1, "uptime_s": 2.0}).encode()
    key = keys.key("blimp-7", keys.HEALTH)
    assert heard(port, key, good).startswith("ok: blimp-7")
    other = good.replace(b"/1.0", b"/9.0")
    assert heard(port, key, other).startswith("problem: blimp-7")


def test_nobody_is_asked_where_the_port_is_held() -> None:
    with socket.create_server(("127.0.0.1", 0)) as held:
        found = running.payloads(station(held.getsockname()[1]))
    assert found.level == OK and "held" in found.found


def test_silence_is_no_problem() -> None:
    found = running.payloads(station(free_port(socket.SOCK_STREAM)), listen_s=0.1)
    assert found.level == OK and "none" in found.found
