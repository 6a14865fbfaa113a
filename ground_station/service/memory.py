"""Memory that nobody uses goes back to the system."""

from __future__ import annotations

import contextlib
import ctypes


def give_back() -> None:
    """Gives what is free inside the C library's heaps back (glibc's malloc_trim(3)).

    A payload that came and went leaves holes between what stays: of 29 flights in an hour the
    intake kept 10 MB that it did not use. Takes some milliseconds; without glibc it does nothing.
    """
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
