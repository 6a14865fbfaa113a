"""Jobs over the cores, each after what it needs; stopped at any moment, the next start goes on."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import shutil
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

from ground_station.calibration.errors import CalibrationError
from ground_station.errors import GroundStationError, MapError
from ground_station.experiments.plan import FlightJob, Job, LensJob, MapJob, Plan, RunJob
from ground_station.experiments.store import Store
from ground_station.progress import Progress
from pi_firmware.wire.errors import BlimpError

_TRIES = 2
"""A process that ends takes its neighbours' pool with it: each gets a second try, alone."""


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

    A film that does not determine its camera is a result, kept with its reason; so is a map that
    cannot be built, and what is left without them.
    """
    store = Store(folder)
    try:
        if isinstance(job, MapJob):
            _build(job, store, data)
        elif isinstance(job, RunJob):
            _run(job, store, data)
        else:
            _film(job, store.flight(job.name))
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
    map_ = maps.load(store.map(job.map_key))
    if job.alter.landmarks < 1:
        from ground_station.experiments.alter import drawn

        map_ = drawn(map_, job.alter.landmarks, job.seed)
    store.write(job.key, measure(map_, flight, job.alter, job.preset, job.settings, job.seed))


def _lens(job: MapJob | RunJob, store: Store) -> Path | None:
    return store.flight(job.lens) if job.lens else None


Work = Callable[[Job, Path, Path], None]


def carry_out(plan: Plan, store: Store, data: Path, jobs: int, do: Work = work) -> int:
    """Does what is not there yet, `jobs` at a time, each by `do`; the number of jobs done.

    Raises the first error that a person can fix, after the others in hand are finished; what was
    done is kept. A job that its process did not survive, or that a defect of the program ended, is
    kept as failed.
    """
    open_ = {key: job for key, job in plan.jobs.items() if not store.done(job)}
    _spread_failures(plan, store, open_)
    done, tries = 0, dict.fromkeys(open_, 0)
    with Progress("experiments, jobs", len(open_)) as progress:
        while open_:
            with _pool(jobs) as pool:
                done += _until_broken(plan, store, data, jobs, do, pool, open_, tries, progress)
    return done


def _until_broken(
    plan: Plan,
    store: Store,
    data: Path,
    jobs: int,
    do: Work,
    pool: ProcessPoolExecutor,
    open_: dict[str, Job],
    tries: dict[str, int],
    progress: Progress,
) -> int:
    """Works until all is done, or until a process dies and with it the pool."""
    running: dict[Future[None], str] = {}
    done = 0
    error: BlimpError | None = None
    while open_ and not (error and not running):
        busy = set(running.values())
        ready = [
            key
            for key in open_
            if key not in busy and not any(need in open_ for need in plan.needs[key])
        ]
        chosen = ready[: jobs - len(running)]
        second = [key for key in ready if tries[key]]
        if second or any(tries[key] == _TRIES for key in busy):
            chosen = [] if running else second[:1]
        for key in [] if error else chosen:
            tries[key] += 1
            running[pool.submit(do, open_[key], store.folder, data)] = key
        finished, _ = wait(running, return_when=FIRST_COMPLETED)
        broken = False
        for future in finished:
            key = running.pop(future)
            try:
                future.result()
            except BrokenProcessPool:
                broken = True
                if tries[key] < _TRIES:
                    continue
                _fail(store, open_[key], f"its process ended {_TRIES} times")
            except BlimpError as caught:
                error = error or caught
                continue
            except Exception as caught:  # a defect of the program's own: the others go on
                _fail(store, open_[key], f"{type(caught).__name__}: {caught}")
            del open_[key]
            done += 1
            progress.step()
            _spread_failures(plan, store, open_)
        if broken:
            return done
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


@contextlib.contextmanager
def _pool(jobs: int) -> Iterator[ProcessPoolExecutor]:
    """Fresh processes; on an error or Ctrl-C they are ended at once: all they do is kept whole."""
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(jobs, context, prepare)
    try:
        yield pool
    except BaseException:
        for process in list(getattr(pool, "_processes", {}).values()):
            process.terminate()
        pool.shutdown(wait=True, cancel_futures=True)
        raise
    pool.shutdown(wait=True, cancel_futures=True)
