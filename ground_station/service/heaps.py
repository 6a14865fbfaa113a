"""How glibc keeps a process's memory (mallopt(3)), so that it does not grow by fragments.

Elsewhere than on glibc nothing happens.
"""

from __future__ import annotations

import contextlib
import ctypes

_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8  # glibc's malloc.h
_LARGE = 8 * 1024 * 1024


def few() -> None:
    """At most two heaps for all threads.

    Each payload brings threads of its own, glibc gives them up to eight heaps a core, and what one
    leaves in each of them adds up: 29 flights in an hour grew the intake by 8 MB.
    """
    _set(_ARENA_MAX, 2)


def large_apart() -> None:
    """Blocks of 8 MB and more lie beside the heap, and are given back when they are freed.

    Else glibc raises that limit to the largest block that was ever freed. A search of the whole map
    takes two of 14 MB, each time others: where what was left of the last ones had been used for
    something small, the heap grew by 17 MB, in two hours of flight twice. No frame has such blocks:
    localizing takes the same time, where a limit of 2 MB costs a twentieth more.
    """
    _set(_MMAP_THRESHOLD, _LARGE)
    _set(_TRIM_THRESHOLD, 2 * _LARGE)  # as glibc would, or each frame pays for its end


def _set(parameter: int, value: int) -> None:
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).mallopt(parameter, value)
