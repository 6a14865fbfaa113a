"""Who does a build's work: threads here, or a Dask cluster. Results come in the items' order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from typing import Any, Protocol, TypeVar

Out = TypeVar("Out")
Sent = TypeVar("Sent")

_ROUNDS_UNDER_WAY = 4
"""Items under way for each that works at a time: enough that nobody waits, and few in memory."""


class Workers(Protocol):
    """Calls functions beside each other.

    `name` is what map.toml says of them; `batch` is how many small things make one call worth
    sending; `here`: they read the files of this machine.
    """

    name: str
    batch: int
    here: bool

    def shared(self, values: Sequence[Any]) -> AbstractContextManager[Sequence[Any]]:
        """Gives, for values that many calls need, what stands for each among their arguments.

        A value is looked up when a call needs it.
        """
        ...

    def map(self, function: Callable[..., Out], items: Iterable[Sequence[Any]]) -> Iterator[Out]:
        """`function(*item)` of each item, in order, with a bounded number in memory.

        When the items end in an error, it is raised after the results of those before it.
        """
        ...


class Threads:
    """Threads of this process."""

    batch = 1
    here = True

    def __init__(self, count: int) -> None:
        self.name = f"{count} threads"
        self._count = count

    @contextmanager
    def shared(self, values: Sequence[Any]) -> Iterator[Sequence[Any]]:
        """The values themselves: threads see the same memory."""
        yield values

    def map(self, function: Callable[..., Out], items: Iterable[Sequence[Any]]) -> Iterator[Out]:
        """As `Workers.map`; a call that raises ends the others."""
        with ThreadPoolExecutor(self._count) as pool:

            def send(item: Sequence[Any]) -> Future[Out]:
                return pool.submit(function, *item)

            try:
                yield from in_order(items, send, Future.result, under_way(self._count))
            finally:
                pool.shutdown(wait=True, cancel_futures=True)


def under_way(count: int) -> int:
    """How many items may be under way where so many are worked on at a time."""
    return _ROUNDS_UNDER_WAY * count


def in_order(
    items: Iterable[Sequence[Any]],
    send: Callable[[Sequence[Any]], Sent],
    receive: Callable[[Sent], Out],
    most: int,
) -> Iterator[Out]:
    """What is received for each item that was sent, in order, with at most `most` under way.

    When the items end in an error, what was sent before it is received first: it can be kept.
    """
    waiting: deque[Sent] = deque()
    iterator = iter(items)
    failure: Exception | None = None
    more = True
    while more or waiting:
        while more and len(waiting) < most:
            try:
                item = next(iterator)
            except StopIteration:
                more = False
            except Exception as error:
                more, failure = False, error
            else:
                waiting.append(send(item))
        if waiting:
            yield receive(waiting.popleft())
    if failure is not None:
        raise failure
