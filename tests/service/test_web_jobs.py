"""Long jobs: one at a time, found again by the next web process, and told with their progress."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import web_station as station

from ground_station.errors import GroundStationError
from ground_station.service.settings import write_run
from ground_station.service.web import jobs as jobs_module
from ground_station.service.web.jobs import Jobs
from ground_station.service.web.problems import Busy

TALKS = """import sys, time
print("match: 3 of 12", file=sys.stderr, flush=True)
print("the page: http://127.0.0.1:4321/secret/", flush=True)
print("pairs: 6 of 8\\x1b[2J", flush=True)
time.sleep(60)
"""


@pytest.fixture
def jobs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Jobs]:
    """Whose commands are small programs of this test's."""
    program = tmp_path / "program"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" "$3"\n')
    program.chmod(0o755)
    monkeypatch.setattr(jobs_module.sys, "executable", str(program))
    one = Jobs(tmp_path)
    yield one
    one.close()


def write(folder: Path, text: str) -> str:
    path = folder / f"{len(list(folder.iterdir()))}.py"
    path.write_text(text)
    return str(path)


def ended(jobs: Jobs) -> dict[str, Any]:
    station.eventually(lambda: not (jobs.state() or {})["running"])
    return jobs.state() or {}


def test_a_job_is_told_with_how_far_it_is_and_ends_with_its_status(
    jobs: Jobs, tmp_path: Path
) -> None:
    assert jobs.state() is None
    jobs.start("build", ["blimp", write(tmp_path, TALKS)])
    state = station.eventually(lambda: (now := jobs.state()) and "8" in now["line"] and now)
    assert state["running"] and state["share"] == 0.75 and state["status"] is None
    assert state["line"] == "pairs: 6 of 8 [2J" and state["step"] == "build"
    assert state["page"] == "http://127.0.0.1:4321/secret/"
    with pytest.raises(Busy):
        jobs.start("build", ["blimp", write(tmp_path, "")])
    jobs.stop()
    state = jobs.state()
    assert state and not state["running"] and state["share"] is None and state["page"] == ""
    with pytest.raises(GroundStationError, match="no job runs"):
        jobs.stop()
    for text, status in (("print('next: blimp x')", 0), ("raise SystemExit('no lens')", 1)):
        jobs.start("calibrate", ["blimp", write(tmp_path, text)])
        state = ended(jobs)
        assert state["status"] == status and state["line"] in ("next: blimp x", "no lens")


def test_the_next_web_process_finds_it_and_can_stop_it(jobs: Jobs, tmp_path: Path) -> None:
    jobs.start("build", ["blimp", write(tmp_path, TALKS)])
    station.eventually(lambda: (jobs.state() or {})["share"])
    after = Jobs(tmp_path)
    assert after.state() == jobs.state()
    with pytest.raises(Busy):
        after.start("build", ["blimp", write(tmp_path, "")])
    after.stop()
    assert not (after.state() or {})["running"] and not (jobs.state() or {})["running"]


def test_one_that_does_not_obey_ends_all_the_same(
    jobs: Jobs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jobs_module, "_STOP_S", 0.5)
    deaf = "import signal, time\nsignal.signal(2, signal.SIG_IGN)\nprint('1 of 2', flush=True)\n"
    jobs.start("build", ["blimp", write(tmp_path, deaf + "time.sleep(60)\n")])
    station.eventually(lambda: (jobs.state() or {})["share"])
    jobs.stop()
    assert not (jobs.state() or {})["running"]


def test_it_gives_way_to_the_flight(jobs: Jobs, tmp_path: Path) -> None:
    said = "import os\nprint(os.nice(0), open('/proc/self/oom_score_adj').read())"
    jobs.start("build", ["blimp", write(tmp_path, said)])
    nice, oom = ended(jobs)["line"].split()
    assert int(nice) == min(19, os.nice(0) + 10) and int(oom) == 500


def test_what_is_left_of_a_killed_run_is_no_job(tmp_path: Path) -> None:
    """Its pid may be another's by now: without the lock nobody is killed."""
    with subprocess.Popen(["sleep", "60"], start_new_session=True) as bystander:
        (tmp_path / "job.json").write_text(
            f'{{"step": "build", "command": "x", "pid": {bystander.pid}, "started_ns": 1}}'
        )
        (tmp_path / "job.log").write_text("1 of 2\n")
        with pytest.raises(GroundStationError):
            Jobs(tmp_path).stop()
        Jobs(tmp_path).close()
        assert bystander.poll() is None
        bystander.send_signal(signal.SIGKILL)


def test_a_job_outlives_a_killed_web_process_and_ends_with_the_service(
    bus_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from ground_station.calibration.board import new_board, write_board

    monkeypatch.chdir(bus_folder)
    write_run(bus_folder, station.run_of(bus_folder))
    write_board(bus_folder / "board.toml", new_board(10, 7, 25.0))
    shutil.copy(station.ATRIUM / "flight.mcap", bus_folder / "recordings" / "a.mcap")

    def job(port: int) -> dict[str, Any]:
        found = httpx.get(f"http://127.0.0.1:{port}/api/state", timeout=20.0).json()["job"]
        return dict(found or {})

    with station.web_process(bus_folder) as (process, port):
        asked = {"step": "calibrate", "choice": "a.mcap"}
        answer = httpx.post(f"http://127.0.0.1:{port}/api/job", json=asked, timeout=20.0)
        assert answer.json()["done"], answer.text
        before = job(port)
        process.kill()
    with station.web_process(bus_folder) as (process, port):
        after = job(port)
        assert after["started_ns"] == before["started_ns"]
        assert after["running"] or after["status"] is not None  # it was not killed, too
        process.send_signal(signal.SIGTERM)
        assert process.wait(30.0) == 0
    assert not (Jobs(bus_folder).state() or {})["running"]


def test_only_what_is_there_is_built_and_nothing_is_overwritten(
    served: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "--out.mp4").touch()
    shutil.copy(station.ATRIUM / "flight.mcap", tmp_path / "recordings" / "a.mcap")
    for body, status in (
        ({"step": "build", "choice": "a.mcap", "map": "../x"}, 422),
        ({"step": "build", "choice": "../recordings/a.mcap", "map": "x"}, 404),
        ({"step": "build", "choice": "none.mcap", "map": "x"}, 404),
        ({"step": "build", "choice": "a.mcap"}, 409),
        ({"step": "build", "choice": "a.mcap", "map": "atrium"}, 409),
        ({"step": "register", "choice": "nowhere"}, 404),
        ({"step": "register", "choice": "atrium"}, 404),
        ({"step": "fly", "choice": "a.mcap"}, 422),
        ({"step": "build"}, 422),
        ({"step": "build", "choice": "--out.mp4", "map": "x"}, 404),
        ({"step": "build", "choice": "a.mcap", "map": "x", "command": "rm"}, 422),
    ):
        assert served[0].post("/api/job", json=body).status_code == status, body
    assert served[0].get("/api/state").json()["job"] is None


def test_a_real_command_goes_on_without_its_page(
    served: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Here it fails, in its own words, and everybody is told."""
    client, bus, _ = served
    monkeypatch.chdir(tmp_path)
    shutil.copy(station.ATRIUM / "flight.mcap", tmp_path / "recordings" / "a.mcap")
    (tmp_path / "board.toml").write_text("no = 'board'\n")
    answer = client.post("/api/job", json={"step": "calibrate", "choice": "a.mcap"})
    assert answer.json()["done"], answer.text
    station.eventually(lambda: not client.get("/api/state").json()["job"]["running"])
    job = client.get("/api/state").json()["job"]
    assert job["status"] == 2 and job["line"].startswith("blimp calibrate: ")
    said = station.eventually(
        lambda: [note for _, _, note in bus.said if getattr(note, "name", "") == "job-ended"]
    )
    assert said[0].level == "warning" and "blimp calibrate: " in said[0].text
    assert client.delete("/api/job").status_code == 409
