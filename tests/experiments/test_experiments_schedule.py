"""Jobs are done once each, in order, and what was done is kept whatever happens."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import dask
import distributed
import pytest

from ground_station.errors import GroundStationError, InputError, MapInUseError
from ground_station.experiments import maps, schedule
from ground_station.experiments.alter import Alteration
from ground_station.experiments.declaration import FlightDeclaration, MapSpec
from ground_station.experiments.plan import FlightJob, LensJob, MapJob, Plan, RunJob
from ground_station.experiments.schedule import carry_out
from ground_station.experiments.store import Store
from ground_station.geometry.camera import THESIS_CAMERA
from ground_station.localization.settings import LocalizerSettings
from ground_station.map.folder import replacing
from ground_station.mapping.settings import MappingSettings
from tests.waiting import eventually


@pytest.fixture(autouse=True)
def imported_once() -> Iterator[None]:
    """Workers are forks of a process that has imported the program: each would take a second."""
    with dask.config.set({"distributed.worker.multiprocessing-method": "forkserver"}):
        yield


def a_plan(runs=3):
    """A flight, a map of it, runs in that."""
    jobs = {
        "f": FlightJob("f", "f.mcap", FlightDeclaration(), 1),
        "m": MapJob("m", MapSpec(), MappingSettings(), "f.mcap"),
    }
    needs = {"f": (), "m": ("f",)}
    for k in range(runs):
        key = f"r{k}"
        flight, settings = FlightDeclaration(), LocalizerSettings()
        jobs[key] = RunJob(key, "m", flight, "f.mcap", k, Alteration(), "default", settings)
        needs[key] = ("m", "f")
    return Plan(jobs, needs, {})


def _note(folder: Path, key: str) -> None:
    with (folder / "done.txt").open("a") as file:
        file.write(key + "\n")


def note(job, folder: Path, data: Path) -> None:
    """Does a job by writing its name down; what it needs must be there."""
    store = Store(folder)
    if isinstance(job, FlightJob):
        store.flight(job.name).parent.mkdir(parents=True)
        store.flight(job.name).write_bytes(b"flight")
    elif isinstance(job, MapJob):
        assert store.flight(job.recording).is_file()
        store.map(job.key).mkdir(parents=True)
        (store.map(job.key) / "map.toml").write_text("map")
    else:
        assert (store.map(job.map_key) / "map.toml").is_file()
        store.write(job.key, {"frames": 1})
    _note(folder, job.key)


def no_map(job, folder: Path, data: Path) -> None:
    if isinstance(job, MapJob):
        Store(folder).write(job.key, {"failed": "no two images overlap"})
        return
    note(job, folder, data)


def no_lens(job, folder: Path, data: Path) -> None:
    if isinstance(job, LensJob):
        Store(folder).write(job.key, {"failed": "the views are too few"})
        return
    note(job, folder, data)


def bad_input(job, folder: Path, data: Path) -> None:
    if isinstance(job, RunJob) and job.seed == 0:
        raise InputError("r0: nothing to read")
    note(job, folder, data)


def dies(job, folder: Path, data: Path) -> None:
    if isinstance(job, RunJob) and job.seed == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    note(job, folder, data)


def defective(job, folder: Path, data: Path) -> None:
    if isinstance(job, RunJob) and job.seed == 1:
        raise ZeroDivisionError("division by zero")
    note(job, folder, data)


def slow(job, folder: Path, data: Path) -> None:
    if isinstance(job, RunJob):
        (folder / f"begun-{job.key}").touch()
        time.sleep(60)
    note(job, folder, data)


def done(folder: Path) -> list[str]:
    path = folder / "done.txt"
    return path.read_text().split() if path.exists() else []


def test_runs_wait_for_other_maps(tmp_path):
    plan = a_plan()
    last = replace(plan.jobs["m"], key="m2")
    plan = Plan({**plan.jobs, "m2": last}, {**plan.needs, "m2": ("f",)}, {})
    assert carry_out(plan, Store(tmp_path), tmp_path, 1, note) == 6
    assert done(tmp_path) == ["f", "m", "m2", "r0", "r1", "r2"]


def test_each_job_is_done_once_after_what_it_needs(tmp_path):
    assert carry_out(a_plan(), Store(tmp_path), tmp_path, 2, note) == 5
    assert done(tmp_path)[:2] == ["f", "m"] and sorted(done(tmp_path)[2:]) == ["r0", "r1", "r2"]
    assert carry_out(a_plan(), Store(tmp_path), tmp_path, 2, note) == 0
    assert len(done(tmp_path)) == 5


def test_a_map_that_cannot_be_built_fails_its_runs_for_the_same_reason(tmp_path):
    store = Store(tmp_path)
    carry_out(a_plan(), store, tmp_path, 2, no_map)
    assert [store.read(f"r{k}") for k in range(3)] == [{"failed": "no two images overlap"}] * 3
    assert done(tmp_path) == ["f"]


def test_a_map_that_a_killed_run_is_still_writing_is_no_failure_that_is_kept(tmp_path, monkeypatch):
    store, job = Store(tmp_path), a_plan().jobs["m"]

    def build(spec, recording, data, settings, part, *more):
        with replacing(part):
            pass

    monkeypatch.setattr(maps, "build", build)
    store.map(job.key).parent.mkdir()
    part = store.map(job.key).with_name(f"{job.key}.making")
    with replacing(part), pytest.raises(MapInUseError):
        schedule.work(job, tmp_path, tmp_path)
    assert not store.done(job)


def test_a_film_that_does_not_tell_the_camera_fails_what_needs_it_and_nothing_else(tmp_path):
    store, plan = Store(tmp_path), a_plan()
    plan.jobs["l"] = LensJob("l", "lens.toml", THESIS_CAMERA, "none", 1)
    plan.needs["l"] = ()
    plan.needs["r1"] = ("m", "f", "l")
    carry_out(plan, store, tmp_path, 2, no_lens)
    assert store.read("r1") == {"failed": "the views are too few"}
    assert sorted(done(tmp_path)) == ["f", "m", "r0", "r2"]
    assert store.done(plan.jobs["l"])
    store.result("l").unlink()
    assert not store.done(plan.jobs["l"])
    store.flight("lens.toml").touch()
    assert store.done(plan.jobs["l"])


def test_what_a_person_can_mend_is_raised_and_the_rest_kept(tmp_path):
    with pytest.raises(InputError, match="r0: nothing to read"):
        carry_out(a_plan(), Store(tmp_path), tmp_path, 1, bad_input)
    assert done(tmp_path)[:2] == ["f", "m"]
    assert carry_out(a_plan(), Store(tmp_path), tmp_path, 1, note) >= 1
    assert sorted(done(tmp_path)) == ["f", "m", "r0", "r1", "r2"]


def test_a_process_that_dies_costs_its_neighbours_nothing_and_at_the_second_try_its_own_job(
    tmp_path,
):
    carry_out(a_plan(), Store(tmp_path), tmp_path, 2, dies)
    # Of one that had just ended the result may be lost with the pool: it is done again.
    assert sorted(set(done(tmp_path))) == ["f", "m", "r0", "r2"]
    assert Store(tmp_path).read("r1") == {
        "failed": "it ended each process that tried it",
        "accident": True,
    }


def test_a_defect_of_the_program_costs_its_own_job_and_is_an_accident(tmp_path):
    carry_out(a_plan(), Store(tmp_path), tmp_path, 2, defective)
    assert sorted(done(tmp_path)) == ["f", "m", "r0", "r2"]
    failed = {"failed": "ZeroDivisionError: division by zero", "accident": True}
    assert Store(tmp_path).read("r1") == failed


def test_an_interrupt_ends_the_workers_and_keeps_what_was_done(tmp_path):
    def interrupt() -> None:
        limit = time.monotonic() + 30
        while not list(tmp_path.glob("begun-*")) and time.monotonic() < limit:
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        thread = threading.Thread(target=interrupt)
        thread.start()
        start_s = time.monotonic()
        with pytest.raises(KeyboardInterrupt):
            carry_out(a_plan(), Store(tmp_path), tmp_path, 2, slow)
        assert time.monotonic() - start_s < 40
        thread.join()
    finally:
        signal.signal(signal.SIGINT, before)
    assert done(tmp_path) == ["f", "m"]


@pytest.fixture
def cluster() -> Iterator[distributed.LocalCluster]:
    """Somebody's own, of one process."""
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0",
        worker_dashboard_address="127.0.0.1:0", silence_logs=logging.CRITICAL,
    ) as cluster:  # fmt: skip
        yield cluster


def test_a_cluster_does_them_too_and_one_that_goes_costs_nothing_that_was_done(tmp_path, cluster):
    plan = a_plan()
    assert carry_out(a_plan(), Store(tmp_path), tmp_path, cluster.scheduler_address, note) == 5
    plan.jobs["r3"] = replace(plan.jobs["r0"], key="r3")
    plan.needs["r3"] = ("m", "f")

    def leave() -> None:
        eventually((tmp_path / "begun-r3").is_file, what="the run")
        cluster.close()

    thread = threading.Thread(target=leave)
    thread.start()
    with pytest.raises(GroundStationError, match="the cluster is gone"):
        carry_out(plan, Store(tmp_path), tmp_path, cluster.scheduler_address, slow)
    thread.join()
    assert sorted(done(tmp_path)) == ["f", "m", "r0", "r1", "r2"]


def test_workers_that_see_other_folders_are_refused_by_name(tmp_path):
    class Client:
        def run(self, function):
            assert function()
            return {"tcp://a:1": True, "tcp://b:1": False}

    with pytest.raises(InputError, match=r"worker tcp://b:1 has no folder .*workers share"):
        schedule._check_shared(Client(), tmp_path)


def linger(job, folder: Path, data: Path) -> None:
    """Says its process and never ends."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "pid.part").write_text(str(os.getpid()))
    (folder / "pid.part").replace(folder / "pid")
    time.sleep(600)


def flown_by_a_process(folder: Path) -> None:
    carry_out(a_plan(), Store(folder), folder, 1, linger)


def test_a_worker_does_not_outlive_a_schedule_that_is_killed(tmp_path):
    flying = multiprocessing.get_context("spawn").Process(
        target=flown_by_a_process, args=(tmp_path,)
    )
    flying.start()
    eventually((tmp_path / "pid").is_file, what="the worker")
    worker = int((tmp_path / "pid").read_text())
    assert Path(f"/proc/{worker}").exists()
    flying.kill()
    flying.join()

    def gone() -> bool:
        try:
            stat = Path(f"/proc/{worker}/stat").read_text()
        except OSError:
            return True
        return stat.rpartition(")")[2].split()[0] == "Z"

    eventually(gone, what="its end")
