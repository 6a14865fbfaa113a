"""`blimp doctor` as one calls it: the table, JSON, the exit status, and who is heard."""

import json
import socket
import subprocess
import sys
import threading
from pathlib import Path

from ground_station.doctor import ROOT, running
from ground_station.doctor.findings import OK, PROBLEM
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
    command = [sys.executable, "-m", "ground_station.cli", "doctor", *map(str, arguments)]
    return subprocess.run(
        command,
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
    names = [finding["name"] for finding in document["findings"]]
    for name in ("python", "packages", "encoder", "map", "clock", "disk", "firewall", "payloads"):
        assert name in names
    assert all(finding["fix"] for finding in document["findings"] if finding["level"] != OK)
    assert "\x1b" not in run.stdout
    assert not (tmp_path / "recordings").exists()


def test_a_problem_is_status_1_and_says_how_to_mend_it(tmp_path: Path) -> None:
    config = configuration(tmp_path)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as held:
        held.bind(("127.0.0.1", 0))
        port = held.getsockname()[1]
        run = doctor("--config", config, "--set", f"video.port={port}", cwd=tmp_path)
    assert run.returncode == 1
    lines = run.stdout.splitlines()
    at = next(i for i, line in enumerate(lines) if line.startswith(f"port {port}/udp"))
    assert "problem" in lines[at]
    assert any("->" in line for line in lines[at + 1 : at + 4])


def test_a_configuration_that_is_refused_is_the_first_finding(tmp_path: Path) -> None:
    run = doctor("--config", configuration(tmp_path, "nmae = 'hall'"), cwd=tmp_path)
    assert run.returncode == 1
    assert "nmae" in run.stdout.splitlines()[0] + run.stdout.splitlines()[1]
    assert "Traceback" not in run.stdout + run.stderr
    assert "python" in run.stdout and "port " not in run.stdout


def test_a_network_without_certificates_is_the_first_finding(tmp_path: Path) -> None:
    run = doctor("--lan", "--config", configuration(tmp_path), cwd=tmp_path)
    assert run.returncode == 1
    assert "blimp keys ground main" in " ".join(run.stdout.split())


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
