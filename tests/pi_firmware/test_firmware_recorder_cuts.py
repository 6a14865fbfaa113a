"""Recordings when power goes or the program is killed: what was promised is there."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from recorded import (
    PowerCut,
    feed,
    files,
    is_cut,
    recorder,
    sequences,
)

MARGIN_S = 2.0
"""What a busy machine may add to `sync_s` before a test calls it lost."""


@pytest.mark.parametrize("padding_bytes", [0, 15_000])
def test_a_power_cut_costs_no_more_than_was_promised(tmp_path: Path, padding_bytes: int) -> None:
    """On the card for certain is what a sync has returned for; the rest may be lost."""
    PowerCut.opened = []
    made = recorder(tmp_path, open_file=PowerCut, sync_s=0.2, max_file_MB=1)
    made.start()
    given: list[float] = []
    rng = random.Random(5)
    cuts: list[tuple[float, list[tuple[Path, bytes]]]] = []
    begin = time.monotonic()
    at = begin + 0.5
    while len(cuts) < 12:
        if time.monotonic() > at and len(given) > 20:
            cut_s = time.monotonic()
            left = [(f.path, f.path.read_bytes()[: f.durable_bytes]) for f in PowerCut.opened]
            cuts.append((cut_s, left))
            at = time.monotonic() + rng.uniform(0.02, 0.3)
        feed(made, [len(given)], padding_bytes)
        given.append(time.monotonic())
        time.sleep(0.005)
    made.stop()
    copy = tmp_path / "copy.mcap"
    late = 0.0
    for cut_s, left in cuts:
        read: list[int] = []
        for _, data in left:
            copy.write_bytes(data)
            read += sequences(copy) if len(data) > 8 else []
        assert read == list(range(len(read)))
        late = max(late, cut_s - given[len(read)])
    assert late < 0.2 + MARGIN_S
    assert made.dropped == 0 and (len(PowerCut.opened) > 1) is (padding_bytes > 0)


CHILD = """
import sys, time
sys.path.insert(0, {tests!r})
from pathlib import Path
from recorded import feed, recorder, unit
unit(0)
made = recorder(Path({folder!r}), sync_s=0.2, max_file_MB=1)
made.start()
for k in range(100_000):
    feed(made, [k], 8000)
    print(k, time.monotonic(), flush=True)
    time.sleep(0.01)
"""


def test_a_killed_program_leaves_all_but_the_last_moments(tmp_path: Path) -> None:
    code = CHILD.format(tests=str(Path(__file__).parent), folder=str(tmp_path / "card"))
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    lines = [process.stdout.readline()]
    reader = threading.Thread(target=lambda: lines.extend(process.stdout or ()))
    reader.start()
    try:
        time.sleep(2.6)
    finally:
        killed_s = time.monotonic()
        process.send_signal(signal.SIGKILL)
        process.wait()
        reader.join()
        process.stdout.close()
    given = [float(line.split()[1]) for line in lines if line.endswith("\n")]
    read = sequences(*files(tmp_path / "card"))
    assert read == list(range(len(read)))
    promised = [k for k, given_s in enumerate(given) if given_s < killed_s - 0.2 - MARGIN_S]
    assert len(promised) > 5 and len(read) >= len(promised)
    made = recorder(tmp_path / "card")
    made.start()  # beside the one without a footer, which stays
    made.stop()
    left = [is_cut(path) for path in files(tmp_path / "card")]
    assert left == [*[False] * (len(left) - 2), True, False]
