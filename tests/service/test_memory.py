"""The intake's threads share two heaps: what each payload's leave behind does not add up."""

import subprocess
import sys

import pytest

HEAPS = """
import ctypes, sys, threading
from ground_station.service.intake import __main__ as intake

if sys.argv[1] == "few":
    intake.few_heaps()
here = threading.Barrier(8)

def hold():
    block = bytes(50_000)
    here.wait()

threads = [threading.Thread(target=hold) for _ in range(8)]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
libc = ctypes.CDLL(None)
libc.fdopen.restype = ctypes.c_void_p
out = ctypes.c_void_p(libc.fdopen(1, b"w"))
libc.malloc_info(0, out)
libc.fflush(out)
"""


def heaps(words: str) -> int:
    done = subprocess.run(
        [sys.executable, "-c", HEAPS, words],
        capture_output=True, text=True, check=True, timeout=120,
    )  # fmt: skip
    return done.stdout.count("<heap nr=")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="asks glibc")
def test_its_threads_share_two_heaps() -> None:
    assert heaps("few") <= 2 < heaps("many")
