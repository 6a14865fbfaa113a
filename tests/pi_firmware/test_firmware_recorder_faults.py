"""Recordings when power goes, the program is killed, the disk is full, broken, slow or silent."""

from __future__ import annotations

import errno
import itertools
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import av
import pytest
from recorded import (
    LIMIT_S,
    BrokenDisk,
    Events,
    FullDisk,
    HeldDisk,
    PowerCut,
    eventually,
    feed,
    files,
    info,
    number_in,
    recorder,
    sequences,
    unit,
    video,
)

from ground_station.recording.h264 import grey
from ground_station.recording.open import open_input
from pi_firmware.recording import folder as folder_module
from pi_firmware.recording import recorder as recorder_module
from pi_firmware.recording import run
from pi_firmware.wire import annexb
from pi_firmware.wire.errors import RecordingError
from pi_firmware.wire.messages import EVENT_RECORDING_ENDED, EVENT_RECORDING_STARTED
from pi_firmware.wire.recording import RecordingReader

MARGIN_S = 2.0
"""What a busy machine may add to `sync_s` before a test calls it lost."""


def is_cut(path: Path) -> bool:
    """Whether a file lacks its end, or is damaged."""
    reader = RecordingReader(path)
    reader.topics()
    return reader.cut


def chunk_ends(path: Path) -> list[int]:
    """Where the records of a file end, up to its index."""
    data, at, ends = path.read_bytes(), 8, []
    while data[at] != 0x0F:  # DataEnd
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
        ends.append(at)
    return ends


def decoded_numbers(units: list[bytes]) -> list[int]:
    """The numbers that the pictures show, all of them decoded without a complaint."""
    codec = av.CodecContext.create("h264", "r")
    codec.thread_count = 1
    codec.options = {"err_detect": "explode"}
    frames = [frame for data in units for frame in codec.decode(av.Packet(data))]
    frames += codec.decode(None)
    assert not any(frame.is_corrupt for frame in frames)
    return [number_in(grey(frame)) for frame in frames]


def test_a_file_cut_anywhere_is_read_up_to_the_cut(tmp_path: Path) -> None:
    made = recorder(tmp_path, sync_s=0.1)
    made.start()
    for block in range(8):
        feed(made, range(block * 10, block * 10 + 10), 3000)
        eventually(lambda: made._run is not None and not made._run.intake._items)
        time.sleep(0.1)  # a sync passes; that it has is not needed
    path = tmp_path / made.stop()
    whole, ends = path.read_bytes(), chunk_ends(path)
    messages = [(c.topic, m.log_time, m.data) for c, m in RecordingReader(path).messages()]
    sizes = [len(data) for _, _, data in messages]
    rng = random.Random(4)
    places = [end + by for end in ends for by in (-40, -1, 0, 1, 9, 40)]
    places += [rng.randrange(8, len(whole)) for _ in range(150)]
    cut = tmp_path / "cut.mcap"
    assert len(ends) > 5
    for place in places:
        cut.write_bytes(whole[:place])
        reader = RecordingReader(cut)
        read = [(c.topic, m.log_time, m.data) for c, m in reader.messages()]
        assert read == messages[: len(read)]
        # Nothing that lies before the cut is missing: only what stands around the messages.
        following = sum(sizes[: len(read) + 1])
        assert len(read) == len(messages) or following + 31 * (len(read) + 1) > place - 4000
        assert reader.cut is (place < len(whole) - 8)
    cut.write_bytes(whole[: ends[-2] + 50])
    source = open_input(cut)
    numbers = [number_in(frame.image) for frame in source]
    assert numbers == [k % 40 for k in range(len(numbers))] and len(numbers) >= 10
    assert "the file ends before its footer" in source.notes[0]


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
    feed(made, [k], {padding_bytes})
    print(k, time.monotonic(), flush=True)
    time.sleep(0.01)
"""


@pytest.mark.parametrize(("after_s", "padding_bytes"), [(2.6, 0), (3.1, 0), (4.3, 5000)])
def test_a_killed_program_leaves_all_but_the_last_moments(
    tmp_path: Path, after_s: float, padding_bytes: int
) -> None:
    code = CHILD.format(
        tests=str(Path(__file__).parent), folder=str(tmp_path / "card"), padding_bytes=padding_bytes
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    lines = [process.stdout.readline()]
    reader = threading.Thread(target=lambda: lines.extend(process.stdout or ()))
    reader.start()
    try:
        time.sleep(after_s)
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


@pytest.mark.parametrize("error", [errno.ENOSPC, errno.EIO])
def test_a_disk_that_takes_no_more_ends_the_recording_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: int
) -> None:
    monkeypatch.setattr(FullDisk, "error", error)
    events = Events()
    made = recorder(tmp_path, events, open_file=FullDisk, sync_s=0.1)
    made.start()
    given = 0
    while made.file:
        feed(made, [given], 3000)
        given += 1
        assert given < 100_000
    feed(made, range(10))  # streaming goes on
    eventually(lambda: len(events.told) > 1)
    assert events.names() == [EVENT_RECORDING_STARTED, EVENT_RECORDING_ENDED]
    (path,) = files(tmp_path)
    assert f"; {path}: No space left on device" in events.told[-1][1]
    read = sequences(path)
    assert read == list(range(len(read))) and 50 < len(read) <= 100
    assert path.stat().st_size == FullDisk.capacity_bytes
    assert decoded_numbers(video(path)) == [k % 40 for k in range(len(video(path)))]
    told_frames = int(events.told[-1][1].split(": ")[1].split()[0])
    assert told_frames <= len(read)  # the reader finds some of the chunk that was cut, too
    assert told_frames + made.dropped in (given, given - 1)  # one may have come after the end
    assert made.stop() == path.name
    monkeypatch.setattr(FullDisk, "capacity_bytes", 10_000_000)
    assert made.start() == "flight-000002.mcap"  # someone made room
    feed(made, range(10))
    made.stop()
    assert sequences(files(tmp_path)[1]) == list(range(10))


def test_a_disk_that_fails_to_sync_ends_the_recording(tmp_path: Path) -> None:
    events = Events()
    made = recorder(tmp_path, events, open_file=BrokenDisk, sync_s=0.1)
    made.start()
    given = 0
    while made.file:
        feed(made, [given])
        given += 1
        time.sleep(0.002)
    eventually(lambda: len(events.told) > 1)
    assert events.told[-1][1].endswith("flight-000001.mcap: Input/output error")
    path = tmp_path / "flight-000001.mcap"
    assert is_cut(path) and len(sequences(path)) + made.dropped in (given, given - 1)


FULL = """
import sys, time
sys.path.insert(0, {tests!r})
from pathlib import Path
from recorded import Events, feed, recorder
events = Events()
made = recorder(Path({folder!r}), events, sync_s=0.1)
made.start()
k = 0
while made.file:
    feed(made, [k], 5000)
    k += 1
while len(events.told) < 2:
    time.sleep(0.01)
print(events.told[-1][1])
made.close()
from recorded import files, sequences
read = sequences(*files(Path({folder!r})))
print(read == list(range(len(read))), len(read))
"""


@pytest.mark.skipif(
    not shutil.which("unshare")
    or subprocess.run(["unshare", "-Urm", "true"], capture_output=True, check=False).returncode,
    reason="no user namespaces here",
)
def test_a_real_disk_that_is_full(tmp_path: Path) -> None:
    code = FULL.format(tests=str(Path(__file__).parent), folder=str(tmp_path / "card"))
    (tmp_path / "code.py").write_text(code)
    (tmp_path / "card").mkdir()
    shell = 'mount -t tmpfs -o size=2m tmpfs "$1" && exec "$2" "$3"'
    done = subprocess.run(
        [
            "unshare", "-Urm", "sh", "-c", shell, "sh",
            str(tmp_path / "card"), sys.executable, str(tmp_path / "code.py"),
        ],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    told, read = done.stdout.splitlines()
    assert told.endswith("flight-000001.mcap: No space left on device")
    assert read.startswith("True ") and int(read.split()[1]) > 200


def test_what_is_to_be_left_free_ends_the_recording_with_a_whole_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, free = os.statvfs(tmp_path), [100_000_000]

    class Disk:
        f_frsize = 1
        f_bavail = property(lambda self: free[0])

    monkeypatch.setattr(folder_module.os, "statvfs", lambda path: Disk())
    assert real.f_bavail > 0
    events = Events()
    made = recorder(tmp_path, events, min_free_MB=50, sync_s=0.1)
    made.start()
    units = feed(made, range(20))
    eventually(lambda: made._run is not None and not made._run.intake._items)
    free[0] = 49_000_000  # another program took it
    feed(made, range(20, 30))
    eventually(lambda: len(events.told) > 1)
    (path,) = files(tmp_path)
    reader = RecordingReader(path)
    assert [sample.data for sample in reader.video()][:20] == units and not reader.cut
    reason = f"recording.folder '{tmp_path}': 49 MB are free, recording.min_free_MB is 50"
    assert reader.metadata_table("recording_end")["reason"] == reason
    assert events.told[-1][1].endswith(reason)
    with pytest.raises(RecordingError, match="49 MB are free"):
        made.start()
    assert files(tmp_path) == [path]


@pytest.fixture
def held_disk(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    released = threading.Event()
    monkeypatch.setattr(HeldDisk, "released", released)
    return released


def test_a_slow_disk_costs_whole_ends_of_groups_and_each_frame_is_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, held_disk: threading.Event
) -> None:
    monkeypatch.setattr(run, "QUEUE_BYTES", 200_000)
    made = recorder(tmp_path, open_file=HeldDisk, sync_s=0.1)
    made.start()
    slowest_s = 0.0
    for k in range(85):  # the disk takes nothing meanwhile
        data, begin = unit(k, 3000), time.monotonic()
        made.unit(info(k), data)
        slowest_s = max(slowest_s, time.monotonic() - begin)
    assert made.dropped > 10 and slowest_s < 1.0
    held_disk.set()
    eventually(lambda: made._run is not None and not made._run.intake._items)
    feed(made, range(85, 120), 3000)
    path = tmp_path / made.stop()
    read = sequences(path)
    assert len(read) + made.dropped == 120 and read[-30:] == list(range(90, 120))
    for before, after in itertools.pairwise(read):
        assert after == before + 1 or after % 10 == 0
    assert decoded_numbers(video(path)) == [k % 40 for k in read]


def test_a_silent_disk_holds_up_neither_stop_nor_stream(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, held_disk: threading.Event
) -> None:
    monkeypatch.setattr(recorder_module, "_STOP_LIMIT_S", 0.3)
    events = Events()
    made = recorder(tmp_path, events, open_file=HeldDisk, sync_s=0.1)
    made.start()
    feed(made, range(30))
    begin = time.monotonic()
    assert made.stop() == "flight-000001.mcap"
    assert time.monotonic() - begin < LIMIT_S / 2
    assert events.told[-1] == (
        EVENT_RECORDING_ENDED,
        "flight-000001.mcap: the disk did not take its end within 0.3 s",
    )
    feed(made, range(30, 60))
    with pytest.raises(RecordingError, match="has not yet answered to the recording before"):
        made.start()
    held_disk.set()
    eventually(lambda: made._hung is not None and not made._hung.is_alive())
    assert made.start() == "flight-000002.mcap"
    made.close()
    assert events.names().count(EVENT_RECORDING_ENDED) == 2
    assert sequences(files(tmp_path)[0]) == list(range(30))


def test_a_disk_that_does_not_even_open_is_refused_in_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_module, "_START_LIMIT_S", 0.3)
    released, events = threading.Event(), Events()

    def hangs(path: Path) -> FullDisk:
        released.wait(LIMIT_S)
        return FullDisk(path)

    made = recorder(tmp_path, events, open_file=hangs)
    with pytest.raises(RecordingError, match=r"no answer within 0\.3 s$"):
        made.start()
    with pytest.raises(RecordingError, match="has not yet answered"):
        made.start()
    released.set()
    eventually(lambda: made._hung is not None and not made._hung.is_alive())
    assert events.told == [] and made.dropped == 0
    made.close()


def test_the_next_file_cannot_be_opened(tmp_path: Path) -> None:
    events = Events()

    def only_one(path: Path) -> FullDisk:
        if path.name != "flight-000001.mcap":
            raise PermissionError(errno.EACCES, "Permission denied")
        return PowerCut(path)  # type: ignore[return-value]

    PowerCut.opened = []
    made = recorder(tmp_path, events, open_file=only_one, max_file_MB=1)
    made.start()
    units = feed(made, range(100), 15_000)
    eventually(lambda: len(events.told) > 1)
    (path,) = files(tmp_path)
    kept = video(path)
    assert kept == units[: len(kept)] and annexb.is_idr(units[len(kept)])
    assert not is_cut(path) and made.dropped == 100 - len(kept)
    assert events.told[-1][1] == (
        f"flight-000001.mcap: {len(kept)} frames; "
        f"{tmp_path / 'flight-000002.mcap'}: Permission denied"
    )


def test_a_file_deleted_under_its_writer_ends_the_recording(tmp_path: Path) -> None:
    """Its bytes would else fill the card, and nobody could see or read them."""
    events = Events()
    made = recorder(tmp_path, events, sync_s=0.1)
    made.start()
    feed(made, range(10))
    (tmp_path / "flight-000001.mcap").unlink()
    given = 10
    while made.file:
        feed(made, [given])
        given += 1
        time.sleep(0.005)
    eventually(lambda: len(events.told) > 1)
    assert events.told[-1][1].endswith("flight-000001.mcap: deleted while it was written")
    shutil.rmtree(tmp_path)
    assert made.start() == "flight-000001.mcap"  # a folder that vanished is made again
    made.close()
    assert not is_cut(tmp_path / "flight-000001.mcap")
