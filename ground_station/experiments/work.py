"""One job in a process of its own."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import signal
import threading
from pathlib import Path

from ground_station.errors import MapError
from ground_station.experiments.plan import FlightJob, Job, MapJob, RunJob
from ground_station.experiments.store import Store


def prepare() -> None:
    """Makes a process a worker: one thread, Ctrl-C is the schedule's to see to, and none outlives
    it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    import cv2

    cv2.setNumThreads(1)


def _end_with_parent() -> None:
    """A pool that is killed leaves its workers waiting for jobs, each with a map in memory."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def work(job: Job, folder: Path, data: Path) -> None:
    """Does a job; its result lies in the store when this returns, and nothing of it before.

    A map that cannot be built is a result, kept with its reason, and so is a run without it.
    """
    store = Store(folder)
    try:
        if isinstance(job, FlightJob):
            _fly(job, store)
        elif isinstance(job, MapJob):
            _build(job, store, data)
        else:
            _run(job, store, data)
    except MapError as error:
        store.write(job.key, {"failed": str(error)})


def _fly(job: FlightJob, store: Store) -> None:
    from ground_station.experiments.flights import fly

    path = store.flight(job.name)
    path.parent.mkdir(parents=True, exist_ok=True)
    fly(job.flight, job.seed, path)


def _build(job: MapJob, store: Store, data: Path) -> None:
    from ground_station.experiments.maps import build, moved

    folder = store.map(job.key)
    part = folder.with_name(f"{folder.name}.making")
    shutil.rmtree(part, ignore_errors=True)
    folder.parent.mkdir(parents=True, exist_ok=True)
    recording = store.flight(job.recording) if job.recording else None
    try:
        build(job.spec, recording, data, job.settings, part, store.cache)
        moved(part, folder)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _run(job: RunJob, store: Store, data: Path) -> None:
    from ground_station.experiments.material import flown
    from ground_station.experiments.measure import measure
    from ground_station.map import store as maps

    recording = store.flight(job.recording) if job.recording else None
    flight = flown(job.flight, recording, data)
    map_ = maps.load(store.map(job.map_key))
    if job.alter.landmarks < 1:
        from ground_station.experiments.thinning import drawn

        map_ = drawn(map_, job.alter.landmarks, job.seed)
    store.write(job.key, measure(map_, flight, job.alter, job.preset, job.settings, job.seed))
