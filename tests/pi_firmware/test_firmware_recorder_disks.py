"""Recordings when the disk is full, broken, slow, silent or somebody else's."""

from __future__ import annotations

import errno
import itertools
import os
import shutil
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
    feed,
    files,
    info,
    is_cut,
    number_in,
    recorder,
    sequences,
    unit,
    video,
)
from waiting import eventually

from ground_station.recording.h264 import grey
from pi_firmware.wire import annexb
from pi_firmware.wire.errors import RecordingError
from pi_firmware.wire.messages import EVENT_RECORDING_ENDED, EVENT_RECORDING_STARTED
from pi_firmware.wire.recorder import folder as folder_module
from pi_firmware.wire.recorder import recorder as recorder_module
from pi_firmware.wire.recorder import run
from pi_firmware.wire.recorder.run import Queue
from pi_firmware.wire.recording import RecordingReader


def decoded_numbers(units: list[bytes]) -> list[int]:
    """The numbers that the pictures show, all of them decoded without a complaint."""
    codec = av.CodecContext.create("h264", "r")
    codec.thread_count = 1
    codec.options = {"err_detect": "explode"}
    frames = [frame for data in units for frame in codec.decode(av.Packet(data))]
    frames += codec.decode(None)
    assert not any(frame.is_corrupt for frame in frames)
    return [number_in(grey(frame)) for frame in frames]


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
    eventually(lambda: made._run is not None and not made._run.queue._items)
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
    eventually(lambda: made._run is not None and not made._run.queue._items)
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


def test_what_comes_while_a_broken_disk_is_told_of_is_left_out_and_after_a_stop_it_is_not() -> None:
    broken, stopped = Queue(1 << 20, 1 << 19), Queue(1 << 20, 1 << 19)
    for queue in (broken, stopped):
        queue.unit(info(0), unit(0))
    broken.close(broken=True)
    stopped.close()
    stopped.close(broken=True)  # its end was asked for before
    for queue in (broken, stopped):
        queue.unit(info(1), unit(1))
    assert (broken.left_out, stopped.left_out) == (1, 0)
    broken.clear()
    assert broken.left_out == 2
