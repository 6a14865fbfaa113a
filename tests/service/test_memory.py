"""Memory that is free inside a process goes back to the system."""

import subprocess
import sys

import pytest

HOLES = """
from pathlib import Path
from ground_station.service import memory

def resident():
    return int(Path("/proc/self/statm").read_text().split()[1])

blocks = [bytes(50_000) for _ in range(2000)]
full = resident()
kept = blocks[-1]  # the heap cannot shrink past it
del blocks
holes = resident()
memory.give_back()
print(full, holes, resident())
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_holes_in_the_heap_are_given_back() -> None:
    done = subprocess.run(
        [sys.executable, "-c", HOLES], capture_output=True, text=True, check=True, timeout=120
    )
    full, holes, after = map(int, done.stdout.split())
    pages = 2000 * 50_000 // 4096
    assert full - holes < 0.1 * pages  # they are held, or there is nothing to give back
    assert holes - after > 0.9 * pages
