"""What threads or large blocks leave behind in a process's heaps does not add up."""

import subprocess
import sys

import pytest

HEAPS = """
import ctypes, sys, threading
from ground_station.service import ending

if sys.argv[1] == "few":
    ending.few_heaps()
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


LARGE = """
import ctypes, sys
from ground_station.service import ending

if sys.argv[1] == "apart":
    ending.large_blocks_apart()
libc = ctypes.CDLL(None)

class Info(ctypes.Structure):
    _fields_ = [(name, ctypes.c_size_t) for name in
                ("arena", "ordblks", "smblks", "hblks", "mapped", "b", "c", "d", "e", "f")]

libc.mallinfo2.restype, libc.malloc.restype = Info, ctypes.c_void_p
libc.free.argtypes = [ctypes.c_void_p]
first = libc.malloc(ctypes.c_size_t(14_200_000))
libc.free(first)
before = libc.mallinfo2().mapped
libc.malloc(ctypes.c_size_t(14_000_000))
print(libc.mallinfo2().mapped - before)
"""


def mapped(words: str) -> int:
    """Bytes beside the heap that a block takes after a larger one was freed."""
    done = subprocess.run(
        [sys.executable, "-c", LARGE, words],
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    return int(done.stdout)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="asks glibc")
def test_a_large_block_lies_beside_the_heap_each_time() -> None:
    assert mapped("apart") >= 14_000_000 and mapped("glibc's way") == 0
