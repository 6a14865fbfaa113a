"""Jobs over a Dask cluster, each after what it needs; stopped at any moment, the next start goes
on."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ground_station.calibration.errors import CalibrationError
from ground_station.errors import GroundStationError, InputError, MapError, MapInUseError
from ground_station.experiments.plan import FlightJob, Job, LensJob, MapJob, Plan, RunJob
from ground_station.experiments.store import Store
from ground_station.mapping.settings import MappingSettings
from ground_station.progress import Progress
from pi_firmware.wire.errors import BlimpError

_TRIES = 2
"""Processes that a job may end here; of a cluster at an address, its scheduler says."""


def work(job: Job, folder: Path, data: Path) -> None:
    """Does a job; its result lies in the store when this returns, and nothing of it before.

    A film that does not determine its camera is a result, kept with its reason; so is a map that
    cannot be built, and what is left without them.
    """
    import cv2

    cv2.setNumThreads(1)  # the other cores have jobs of their own
    store = Store(folder)
    try:
        if isinstance(job, MapJob):
            _build(job, store, data)
        elif isinstance(job, RunJob):
            _run(job, store, data)
        else:
            _film(job, store.flight(job.name))
    except MapInUseError:  # of a run that was killed a moment ago
        raise
    except (MapError, CalibrationError) as error:
        store.write(job.key, {"failed": str(error)})


def _film(job: LensJob | FlightJob, path: Path) -> None:
    from ground_station.experiments.flights import fly
    from ground_station.experiments.lenses import find

    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(job, FlightJob):
        fly(job.flight, job.seed, path)
    else:
        find(job.camera, job.processing, job.seed, path)


def _build(job: MapJob, store: Store, data: Path) -> None:
    from ground_station.experiments.maps import build

    folder = store.map(job.key)
    part = folder.with_name(f"{folder.name}.making")
    shutil.rmtree(part, ignore_errors=True)
    folder.parent.mkdir(parents=True, exist_ok=True)
    recording = store.flight(job.recording) if job.recording else None
    try:
        build(job.spec, recording, data, job.settings, part, store.cache, _lens(job, store))
        shutil.rmtree(folder, ignore_errors=True)  # a cut attempt
        part.replace(folder)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _run(job: RunJob, store: Store, data: Path) -> None:
    from ground_station.experiments.material import flown
    from ground_station.experiments.measure import measure
    from ground_station.map import store as maps

    recording = store.flight(job.recording) if job.recording else None
    flight = flown(job.flight, recording, data, _lens(job, store))
    map_ = job.alter.map(maps.load(store.map(job.map_key)), job.seed)
    store.write(job.key, measure(map_, flight, job.alter, job.preset, job.settings, job.seed))


def _lens(job: MapJob | RunJob, store: Store) -> Path | None:
    return store.flight(job.lens) if job.lens else None


Work = Callable[[Job, Path, Path], None]


def carry_out(plan: Plan, store: Store, data: Path, where: str | int, do: Work = work) -> int:
    """Does what is not there yet, each job by `do`; the number of jobs done.

    `where`: at the address of a cluster whose workers see the store's folder and the data, or in so
    many processes here. Raises the first error that a person can fix, after the others in hand are
    finished; what was done is kept. A job that its process did not survive, or that a defect of the
    program ended, is kept as failed.
    """
    open_ = {key: job for key, job in plan.jobs.items() if not store.done(job)}
    _spread_failures(plan, store, open_)
    if not open_:
        return 0
    # Imported only when there is work: it takes a second.
    import dask
    import distributed  # noqa: F401 -- whose configuration is set

    from ground_station.mapping.construction.cluster import CANCELLED, client_of

    of_cluster = {
        "distributed.scheduler.allowed-failures": _TRIES - 1,
        "distributed.scheduler.worker-ttl": None,  # a job may hold its process for minutes
    }
    with (
        dask.config.set(of_cluster),
        client_of(where, MappingSettings()) as client,
        client.as_current(),
        Progress("experiments, jobs", len(open_)) as progress,
    ):
        if isinstance(where, str):
            store.folder.mkdir(parents=True, exist_ok=True)
            for folder in filter(Path.is_dir, (store.folder, data)):
                _check_shared(client, folder.resolve())
        try:
            return _until_done(plan, store, data, do, client, open_, progress)
        except CANCELLED:
            raise GroundStationError(
                "the cluster is gone; what was done is kept: start again to go on"
            ) from None


def _check_shared(client: Any, folder: Path) -> None:
    for address, there in client.run(folder.is_dir).items():
        if not there:
            raise InputError(
                f"the worker {address} has no folder {folder}: flights, maps and runs are files; "
                "give --out and --data in folders that all workers share"
            )


def _until_done(
    plan: Plan,
    store: Store,
    data: Path,
    do: Work,
    client: Any,
    open_: dict[str, Job],
    progress: Progress,
) -> int:
    from distributed import KilledWorker, wait

    running: dict[Any, str] = {}
    done = 0
    error: BlimpError | None = None
    while open_ and not (error and not running):
        busy = set(running.values())
        ready = [
            key
            for key in open_
            if key not in busy and not any(need in open_ for need in plan.needs[key])
        ]
        # Runs come last: beside the last map, which takes longest, they fill the other processes.
        ready.sort(key=lambda key: isinstance(open_[key], RunJob))
        # No more than are worked on at a time, so that none waits beside one that ends its process.
        free = max(1, sum(client.nthreads().values())) - len(running)
        for key in [] if error else ready[: max(0, free)]:
            args = open_[key], store.folder.resolve(), data.resolve()
            running[client.submit(do, *args, pure=False)] = key
        for future in wait(list(running), return_when="FIRST_COMPLETED").done:
            key = running.pop(future)
            try:
                future.result()
            except KilledWorker:
                _fail(store, open_[key], "it ended each process that tried it")
            except BlimpError as caught:
                error = error or caught
                continue
            except Exception as caught:  # a defect of the program's own: the others go on
                _fail(store, open_[key], f"{type(caught).__name__}: {caught}")
            del open_[key]
            done += 1
            progress.step()
            _spread_failures(plan, store, open_)
    if error:
        raise error
    return done


def _fail(store: Store, job: Job, reason: str) -> None:
    if isinstance(job, FlightJob):  # nothing can go on without it
        raise GroundStationError(f"{job.name}: {reason}")
    store.write(job.key, {"failed": reason, "accident": True})


def _spread_failures(plan: Plan, store: Store, open_: dict[str, Job]) -> None:
    """What needs a map that cannot be built fails for the map's reason, without being tried."""
    for key in list(open_):
        for need in plan.needs[key]:
            failure = None if need in open_ else store.failure(plan.jobs[need])
            if failure is not None:
                store.write(key, failure)
                del open_[key]
                break
