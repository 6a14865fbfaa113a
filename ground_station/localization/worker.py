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
    """At most one job at a time; its result lands some calls of `collect` after it was given.

    With `lag` 1 or more it lands at exactly that call, which waits if it must: the same frames then
    give the same poses, however fast the machine. With 0 it lands when it is ready.
    """

    def __init__(self, lag: int) -> None:
        self.lag = lag
        self._executor: ThreadPoolExecutor | None = None
        self._job: Future[Result] | None = None
        self._age = 0
        self._due = lag

    @property
    def busy(self) -> bool:
        """Whether a job was given whose result has not landed."""
        return self._job is not None

    def submit(self, job: Callable[[], Result], lag: int | None = None) -> None:
        """Starts a job; one that has not landed is forgotten. It may have a lag of its own.

        A lag of its own is no more than the worker's, so that with 0 nothing is ever waited for.
        """
        if self._executor is None:
            self._executor = ThreadPoolExecutor(
                1, thread_name_prefix="keyframes", initializer=_step_aside
            )
        self.drop()
        self._due = self.lag if lag is None else min(lag, self.lag)
        self._job, self._age = self._executor.submit(job), 0

    def collect(self) -> Result | None:
        """The result that lands at this call, or None. What the job raised is raised here."""
        job = self._job
        if job is None:
            return None
        self._age += 1
        if self._age < self._due or (self._due == 0 and not job.done()):
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
