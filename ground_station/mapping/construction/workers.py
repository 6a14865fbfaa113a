"""Work spread over the cores: results in order, with a bounded number of items in memory."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

In = TypeVar("In")
Out = TypeVar("Out")


def parallel(function: Callable[[In], Out], items: Iterable[In], threads: int) -> Iterator[Out]:
    """`map` on a few threads, results in order, with a bounded number of items in memory."""
    waiting: deque[Future[Out]] = deque()
    iterator = iter(items)
    with ThreadPoolExecutor(threads) as pool:
        try:
            for item in itertools.islice(iterator, 4 * threads):
                waiting.append(pool.submit(function, item))
            while waiting:
                yield waiting.popleft().result()
                for item in itertools.islice(iterator, 1):
                    waiting.append(pool.submit(function, item))
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
