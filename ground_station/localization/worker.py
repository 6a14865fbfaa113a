"""One thread beside the tracking, for what takes longer than a frame."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

Result = TypeVar("Result")

BESIDE_NICE = 5
"""What the worker's thread leaves to tracking, where both want the same core."""


class Worker(Generic[Result]):
    """At most one job at a time; its result lands some time of the frames after it was given.

    With a `lag_s` it lands at the first frame that is so much later, which waits if it must: the
    same frames then give the same poses, however fast the machine. With 0 it lands when it is
    ready.
    """

    def __init__(self, lag_s: float) -> None:
        self.lag_s = lag_s
        self._executor: ThreadPoolExecutor | None = None
        self._job: Future[Result] | None = None
        self._given_ns = self._due_ns = 0

    @property
    def busy(self) -> bool:
        """Whether a job was given whose result has not landed."""
        return self._job is not None

    def waiting_s(self, time_ns: int) -> float:
        """How long before a frame's time the job was given whose result has not landed; else 0."""
        return (time_ns - self._given_ns) / 1e9 if self.busy else 0.0

    def submit(self, job: Callable[[], Result], time_ns: int) -> None:
        """Starts a frame's job; one that has not landed is forgotten."""
        if self._executor is None:
            self._executor = ThreadPoolExecutor(
                1, thread_name_prefix="keyframes", initializer=_step_aside
            )
        self.drop()
        self._given_ns, self._due_ns = time_ns, time_ns + int(1e9 * self.lag_s)
        self._job = self._executor.submit(job)

    def collect(self, time_ns: int) -> Result | None:
        """The result that lands at a frame, or None. What the job raised is raised here."""
        job = self._job
        if job is None:
            return None
        if time_ns < self._due_ns or (self.lag_s == 0 and not job.done()):
            return None
        self._job = None
        return job.result()

    def drop(self) -> None:
        """Forgets the job, once it no longer runs: what it works with is then free."""
        job, self._job = self._job, None
        if job is not None and not job.cancel():
            job.exception()


def _step_aside() -> None:
    """Lets tracking go before this thread; on Linux a thread has a priority of its own."""
    number = threading.get_native_id()
    with contextlib.suppress(OSError):
        nice = min(os.getpriority(os.PRIO_PROCESS, number) + BESIDE_NICE, 19)
        os.setpriority(os.PRIO_PROCESS, number, nice)
