"""Memory that nobody uses goes back to the system."""

from __future__ import annotations

import contextlib
import ctypes


def give_back() -> None:
    """Gives what is free inside the C library's heaps back (glibc's malloc_trim(3)).

    A payload that came and went leaves holes between what stays: 29 flights in an hour grew the
    intake by 6 MB; over shorter flights what it used stayed the same and what was free did not.
    Without glibc it does nothing.
    """
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
