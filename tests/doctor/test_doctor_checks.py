"""What the doctor finds: each check on a machine that is well, and on one that is not."""

import dataclasses
import datetime
import json
import os
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from ground_station.doctor import ROOT, locked, machine, network, running, software, world
from ground_station.doctor.findings import (
    OK,
    PROBLEM,
    WARNING,
    Check,
    Finding,
    examine,
    ok,
    problem,
    text,
    warning,
)
from ground_station.keys.authority import Authority
from ground_station.service.settings import (
    HttpSettings,
    MapSettings,
    RecordingSettings,
    StationSettings,
    TelemetrySettings,
    VideoSettings,
)

ATRIUM = ROOT / "maps" / "atrium"


def only(settings: StationSettings, **tables: object) -> StationSettings:
    return dataclasses.replace(settings, **tables)  # type: ignore[arg-type]


def test_a_check_that_breaks_is_a_finding_and_stops_no_other() -> None:
    def broken() -> Finding:
        raise ZeroDivisionError("of\ntwo lines")

    found = examine([Check("one", broken), Check("two", lambda: ok("two", "fine"))])
    assert [(f.name, f.level) for f in found] == [("one", PROBLEM), ("two", OK)]
    assert "ZeroDivisionError: of two lines" in found[0].found


def test_the_table_fits_its_width_and_has_colour_only_where_asked() -> None:
    found = [
        ok("a", "x " * 100),
        warning("bb", "little", "more"),
        problem("c", "\x1b[2J", "end it"),
    ]
    plain = text(found, colour=False, width=70)
    assert max(map(len, plain.splitlines())) <= 70
    assert "\x1b" not in plain
    assert plain.splitlines()[-1] == "1 problem and 1 warning in 3 checks"
    assert text(found, colour=True, width=70).count("\x1b[0m") == 3


def test_another_version_and_a_missing_package_are_named(tmp_path: Path) -> None:
    project = '[project]\ndependencies = ["tqdm", "certainly-not-there"]\n'
    (tmp_path / "pyproject.toml").write_text(project)
    (tmp_path / "requirements.lock").write_text("tqdm==0.0.1 \\\n    --hash=sha256:00\n")
    found = software.packages(tmp_path)
    assert (found.level, "tqdm" in found.found and "0.0.1" in found.found) == (WARNING, True)
    with (tmp_path / "requirements.lock").open("a") as lock:
        lock.write("certainly-not-there==1.0 \\\n    --hash=sha256:00\n")
    found = software.packages(tmp_path)
    assert (found.level, "certainly-not-there" in found.found) == (PROBLEM, True)


def test_a_module_that_fails_and_one_that_ends_the_program_are_both_named(tmp_path: Path) -> None:
    (tmp_path / "raises_here.py").write_text("raise ImportError('no such symbol')")
    (tmp_path / "ends_here.py").write_text("import os, signal; os.kill(os.getpid(), 11)")
    (tmp_path / "good_here.py").write_text("")
    names = ["raises_here", "ends_here", "good_here", "not_there_at_all"]
    code = f"from ground_station.doctor.software import imports; print(imports({names}))"
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}:{ROOT}"}
    run = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=120
    )
    found = eval(run.stdout)
    assert [entry.split()[0] for entry in found] == ["raises_here", "ends_here", "not_there_at_all"]
    assert "no such symbol" in found[0] and "-11" in found[1]


def test_the_lock_s_part_that_is_installed_has_no_development_tools() -> None:
    run = subprocess.run(
        [sys.executable, "-m", locked.__name__],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    names = {line.split("==")[0] for line in run.stdout.splitlines() if "==" in line[:60]}
    assert {"numpy", "gtsam", "eclipse-zenoh", "fastapi", "starlette", "packaging"} <= names
    assert not names & {"mypy", "ruff", "playwright", "schemathesis", "evo"}
    assert run.stdout.count("--hash=sha256:") > len(names)
    # Entries for other Pythons stay, as the installation may have another than this one.
    assert run.stdout.count("\nnumpy==") > 1


def test_a_port_that_is_held_names_its_holder() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as held:
        held.bind(("127.0.0.1", 0))
        video = VideoSettings(port=held.getsockname()[1])
        found = {f.name: f for f in network.ports(only(StationSettings(), video=video))}
        finding = found[f"port {video.port}/udp"]
        assert finding.level == PROBLEM
        assert str(os.getpid()) in finding.found and "video.port" in finding.fix
    with socket.create_server(("127.0.0.1", 0)) as listening:
        http = HttpSettings(port=listening.getsockname()[1])
        names = {f.name: f for f in network.ports(only(StationSettings(), http=http))}
        assert names[f"port {http.port}/tcp"].level == PROBLEM
    again = {f.name: f for f in network.ports(only(StationSettings(), video=video))}
    assert again[f"port {video.port}/udp"].level == OK


@pytest.mark.parametrize(
    ("answer", "level"),
    [(b'HTTP/1.0 200 OK\r\n\r\n{"status":"ok"}', OK), (b"220 mail\r\n", PROBLEM)],
)
def test_ports_are_the_service_s_own_where_it_answers(answer: bytes, level: str) -> None:
    def serve(page: socket.socket) -> None:
        with page.accept()[0] as client:
            client.recv(4096)
            client.sendall(answer)

    with (
        socket.create_server(("127.0.0.1", 0)) as page,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as held,
    ):
        held.bind(("127.0.0.1", 0))
        http = HttpSettings(port=page.getsockname()[1])
        video = VideoSettings(port=held.getsockname()[1])
        threading.Thread(target=serve, args=(page,), daemon=True).start()
        found = network.ports(only(StationSettings(), http=http, video=video))
        names = {f"port {video.port}/udp", f"port {http.port}/tcp"}
        assert {f.level for f in found if f.name in names} == {level}


def test_an_address_of_another_machine_cannot_be_listened_on() -> None:
    video = VideoSettings(host="192.0.2.1")  # RFC 5737: nobody's
    found = next(network.ports(only(StationSettings(), video=video)))
    assert found.level == PROBLEM and "video.host" in found.fix


def test_the_receive_buffer_s_limit(tmp_path: Path) -> None:
    limit = tmp_path / "rmem_max"
    limit.write_text("212992\n")
    found = network.receive_buffer(limit)
    assert found.level == WARNING and "net.core.rmem_max=4194304" in found.fix
    limit.write_text("8388608\n")
    assert network.receive_buffer(limit).level == OK


def test_a_firewall_that_drops_something_is_named_with_how_to_open_it() -> None:
    ports = [network.Port("video.port", socket.SOCK_DGRAM, "0.0.0.0", 5600)]
    closed = "*filter\n:INPUT DROP [0:0]\nCOMMIT\n"
    found = network.judged(ports, {"nft": '{"nftables": []}', "iptables": closed})
    assert found.level == WARNING and "(iptables)" in found.found and "5600" in found.fix
    rejecting = '{"nftables": [{"rule": {"expr": [{"reject": null}]}}]}'
    assert network.judged(ports, {"nft": rejecting}).level == WARNING
    opened = closed.replace("DROP", "ACCEPT")
    assert network.judged(ports, {"nft": '{"nftables": []}', "iptables": opened}).level == OK


def test_loopback_needs_no_firewall() -> None:
    assert network.firewall_rules(StationSettings()).level == OK


def test_discovery_s_interface() -> None:
    assert network.discovery(StationSettings()).level == OK
    there = TelemetrySettings(discoverable="lo")
    assert network.discovery(only(StationSettings(), telemetry=there)).level == OK
    without = TelemetrySettings(discoverable="wlan7")
    found = network.discovery(only(StationSettings(), telemetry=without))
    assert found.level == PROBLEM and "certificates" in found.found


def test_the_token_s_file(tmp_path: Path) -> None:
    assert network.token(HttpSettings()).level == OK
    assert network.token(HttpSettings(host="0.0.0.0")).level == PROBLEM
    path = tmp_path / "token"
    settings = HttpSettings(host="0.0.0.0", token_file=str(path))
    assert network.token(settings).level == PROBLEM
    path.write_text("x" * 40)
    path.chmod(0o644)
    assert "0644" in network.token(settings).found
    path.chmod(0o600)
    found = network.token(settings)
    assert found.level == OK and "xxxx" not in found.found


def test_the_map() -> None:
    levels = {f.name: f.level for f in world.maps(MapSettings(folder=str(ATRIUM)), "default")}
    assert levels == {"map": OK, "features": OK, "floor plan": OK}


@pytest.mark.parametrize(
    ("file", "old", "new", "name", "level"),
    [
        ("map.toml", 'frame = "world"', 'frame = "sfm"', "map", PROBLEM),
        ("map.toml", 'sha256 = "9a', 'sha256 = "00', "features", PROBLEM),
        ("map.toml", "format = 1", "format = 99", "map", PROBLEM),
        ("floorplan.yaml", "resolution:", "resolved:", "floor plan", PROBLEM),
    ],
)
def test_a_map_that_is_not_fit(
    tmp_path: Path, file: str, old: str, new: str, name: str, level: str
) -> None:
    for path in ATRIUM.iterdir():
        if path.is_file() and path.suffix != ".mcap":
            (tmp_path / path.name).write_bytes(path.read_bytes())
    changed = (tmp_path / file).read_text()
    assert old in changed
    (tmp_path / file).write_text(changed.replace(old, new, 1))
    found = {f.name: f for f in world.maps(MapSettings(folder=str(tmp_path)), "default")}
    assert found[name].level == level and found[name].fix


def test_a_map_that_is_cut_or_away(tmp_path: Path) -> None:
    (found,) = world.maps(MapSettings(folder=str(tmp_path / "none")), "default")
    assert found.level == PROBLEM
    for name in ("map.toml", "keyframes.safetensors"):
        (tmp_path / name).write_bytes((ATRIUM / name).read_bytes())
    (tmp_path / "landmarks.safetensors").write_bytes(
        (ATRIUM / "landmarks.safetensors").read_bytes()[:5000]
    )
    (found,) = world.maps(MapSettings(folder=str(tmp_path)), "default")
    assert found.level == PROBLEM and "landmarks.safetensors" in found.found


def certified(folder: Path, name: str = "main") -> Finding:
    telemetry = TelemetrySettings(listen=["tls/127.0.0.1:7447"], certificates=str(folder))
    return world.certificate(StationSettings(name=name, telemetry=telemetry))


def test_the_certificate(tmp_path: Path) -> None:
    authority = Authority.create(tmp_path / "keys")
    folder = authority.add("ground", "main")
    authority.add("payload", "blimp-1")
    good = certified(folder)
    assert good.level == OK and "blimp-1" in good.found
    assert certified(folder, "other").level == PROBLEM
    (folder / "key.pem").chmod(0o644)
    assert "chmod" in certified(folder).fix
    (folder / "key.pem").chmod(0o600)
    (folder / "srtp" / "blimp-1.key").unlink()
    assert "blimp-1" in certified(folder).found
    another = authority.add("ground", "second")
    (folder / "key.pem").write_bytes((another / "key.pem").read_bytes())
    assert certified(folder).level == PROBLEM
    soon = certified(authority.add("ground", "soon", days=10), "soon")
    year = f"{datetime.datetime.now(datetime.UTC):%Y}"
    assert soon.level == WARNING and year[:2] in soon.found
    (folder / "certificate.pem").unlink()
    assert certified(folder).level == PROBLEM


def test_a_card_that_was_written_for_another_station_is_a_problem(tmp_path: Path) -> None:
    authority = Authority.create(tmp_path / "keys")
    certificates = str(authority.add("ground", "main"))
    telemetry = TelemetrySettings(listen=["tls/127.0.0.1:7447"], certificates=certificates)
    note = authority.add("payload", "blimp-1") / "flashed.json"
    settings = only(StationSettings(), telemetry=telemetry)
    assert list(world.cards(settings)) == list(world.cards(StationSettings())) == []
    for written, level in (
        ({"peers": ["ground.main"], "time_s": 0}, OK),
        ({"peers": ["ground.hall"], "time_s": 0}, PROBLEM),
        ({"peers": ["ground.hall"]}, WARNING),
    ):
        note.write_text(json.dumps(written))
        (found,) = world.cards(settings)
        assert (found.name, found.level) == ("card of blimp-1", level)
        assert "ground.hall; this station is ground.main" in found.found or level != PROBLEM


def test_a_station_on_loopback_is_told_what_the_network_needs() -> None:
    assert "blimp serve --lan" in network.reach(StationSettings()).found
    video = only(StationSettings(), video=VideoSettings(host="0.0.0.0"))
    assert network.reach(video).level == WARNING
    telemetry = TelemetrySettings(listen=["tls/0.0.0.0:7447"], certificates="/keys")
    assert network.reach(only(video, telemetry=telemetry)).found == "the network: 0.0.0.0"


def test_video_beyond_loopback_without_a_certificate_is_a_warning() -> None:
    settings = only(StationSettings(), video=VideoSettings(host="0.0.0.0"))
    assert world.certificate(settings).level == WARNING


def test_memory(tmp_path: Path) -> None:
    def free(kilobytes: int) -> str:
        path = tmp_path / "meminfo"
        path.write_text(f"MemTotal: 8000000 kB\nMemAvailable: {kilobytes} kB\n")
        return machine.memory(4, path).level

    assert [free(500_000), free(1_200_000)] == [PROBLEM, WARNING]


def test_the_disk(tmp_path: Path) -> None:
    folder = tmp_path / "not" / "yet"
    here = RecordingSettings(folder=str(folder), min_free_MB=0, max_file_MB=1)
    assert machine.disk(here).level in (OK, WARNING)  # warned of where the disk is slow
    assert not folder.exists() and not list(tmp_path.iterdir())
    full = RecordingSettings(folder=str(tmp_path), min_free_MB=10_000_000)
    assert machine.disk(full).level == PROBLEM
    tmp_path.joinpath("file").write_text("")
    assert machine.disk(RecordingSettings(folder=str(tmp_path / "file"))).level == PROBLEM


def test_the_clock(tmp_path: Path) -> None:
    assert machine.clock(tmp_path).level == OK  # timesyncd's mark is there
    assert machine.clock(tmp_path / "none").level in (OK, WARNING)


@pytest.mark.parametrize(
    ("state", "level"),
    [
        ({"LoadState": "not-found", "ActiveState": "inactive"}, OK),
        ({"LoadState": "loaded", "ActiveState": "active", "UnitFileState": "enabled"}, OK),
        ({"LoadState": "loaded", "ActiveState": "active", "UnitFileState": "disabled"}, WARNING),
        ({"LoadState": "loaded", "ActiveState": "active", "NRestarts": "3"}, WARNING),
        ({"LoadState": "loaded", "ActiveState": "inactive"}, WARNING),
        ({"LoadState": "loaded", "ActiveState": "failed"}, PROBLEM),
        ({"LoadState": "loaded", "SubState": "auto-restart", "ActiveState": "activating"}, PROBLEM),
        ({"LoadState": "bad-setting", "ActiveState": "inactive"}, PROBLEM),
    ],
)
def test_the_installed_service(state: dict[str, str], level: str) -> None:
    assert running.judge_unit(state).level == level


def test_a_machine_without_systemd_is_well(tmp_path: Path) -> None:
    assert running.unit(tmp_path / "none").level == OK
