"""Recordings on the payload: what is in them, their names and bounds, and who can read them."""

from __future__ import annotations

import contextlib
import json
import math
import subprocess
import sys
import time
import tracemalloc
from pathlib import Path

import pytest
from mcap.reader import make_reader
from recorded import (
    PERIOD_NS,
    START_NS,
    Events,
    feed,
    files,
    info,
    number_in,
    recorder,
    sequences,
    unit,
    video,
)
from tapped import fly
from waiting import eventually

from ground_station.recording.open import open_input
from pi_firmware import gstreamer
from pi_firmware.recording import Recorder
from pi_firmware.settings import RecordingSettings
from pi_firmware.sources import decoding
from pi_firmware.sources.decoding import DECODERS, RecordingDecoder
from pi_firmware.wire import annexb, messages
from pi_firmware.wire.errors import RecordingError, StreamError
from pi_firmware.wire.messages import EVENT_RECORDING_ENDED, EVENT_RECORDING_STARTED
from pi_firmware.wire.recorder import file, run
from pi_firmware.wire.recording import VIDEO_TOPIC, RecordingReader

BATTERY = messages.Battery(time_ns=START_NS + 5, voltage=3.9, percentage=0.5)
GATE = messages.Gate(
    time_ns=START_NS + 7, capture_ns=START_NS, sequence=0, passed=True, heartbeat=False,
    entropy_bits=7.0, sharpness=1.0, captured=1, gated=0, heartbeats=0, sent=1, ssrc=9,
)  # fmt: skip


def test_a_recording_holds_exactly_what_went_in(tmp_path: Path) -> None:
    events = Events()
    settings = RecordingSettings(folder=str(tmp_path / "new"), min_free_MB=0)
    made = Recorder(settings, events, head={"payload": {"payload_id": "blimp-1"}})
    assert made.start() == made.file == "flight-000001.mcap"
    made.message("battery", BATTERY)
    units = feed(made, range(60))
    made.message("gate", GATE)
    assert made.stop() == "flight-000001.mcap"
    assert (made.file, made.size_MB, made.dropped) == ("", 0.0, 0)
    path = tmp_path / "new" / "flight-000001.mcap"
    reader = RecordingReader(path)
    assert [(s.time_ns, s.data) for s in reader.video()] == [
        (START_NS + k * PERIOD_NS, units[k]) for k in range(60)
    ]
    assert list(reader.json("/camera/frame")) == [
        (info(k).time_ns, {"sequence": k, "exposure_s": info(k).exposure_s, "gain": 2.0})
        for k in range(60)
    ]
    for kind, message in (("battery", BATTERY), ("gate", GATE)):
        ((time_ns, value),) = reader.json(f"/blimp/{kind}")
        assert time_ns == message.time_ns and value == json.loads(messages.encode(message))
    assert not reader.cut
    assert reader.metadata == {
        "recording": {"first_file": "flight-000001.mcap", "part": "1"},
        "payload": {"payload_id": "blimp-1"},
        "recording_end": {"frames": "60", "left_out": "0"},
    }
    assert events.told == [
        (EVENT_RECORDING_STARTED, "flight-000001.mcap"),
        (EVENT_RECORDING_ENDED, "flight-000001.mcap: 60 frames"),
    ]
    with path.open("rb") as raw:
        summary = make_reader(raw).get_summary()
        assert summary is not None and summary.statistics is not None
        assert summary.statistics.message_count == 122
        schemas = {c.topic: summary.schemas[c.schema_id] for c in summary.channels.values()}
    assert {topic: (schema.name, schema.encoding) for topic, schema in schemas.items()} == {
        VIDEO_TOPIC: ("foxglove.CompressedVideo", "protobuf"),
        "/camera/frame": ("blimp.Frame", "jsonschema"),
        "/blimp/battery": ("blimp.battery", "jsonschema"),
        "/blimp/gate": ("blimp.gate", "jsonschema"),
    }


def test_it_begins_with_an_idr_and_asks_for_one(tmp_path: Path) -> None:
    asked: list[int] = []
    made = recorder(tmp_path, force_idr=lambda: asked.append(1))
    made.start()
    units = feed(made, range(3, 25))
    path = tmp_path / made.stop()
    assert asked == [1] and made.dropped == 0
    assert video(path) == units[7:] and annexb.is_idr(units[7])
    assert sequences(path) == list(range(10, 25))


def test_a_full_file_goes_on_in_the_next_without_a_gap(tmp_path: Path) -> None:
    events = Events()
    made = recorder(tmp_path, events, max_file_MB=1)
    made.start()
    units = feed(made, range(300), 15_000)
    assert made.stop() == "flight-000005.mcap"
    paths = files(tmp_path)
    assert len(paths) == 5 and made.dropped == 0
    assert video(*paths) == units and sequences(*paths) == list(range(300))
    for number, path in enumerate(paths, 1):
        assert annexb.is_idr(video(path)[0])
        assert 500_000 < path.stat().st_size <= 1_000_000 or number == 5
        reader = RecordingReader(path)
        assert reader.topics().keys() == {VIDEO_TOPIC, "/camera/frame"} and not reader.cut
        assert reader.metadata["recording"]["part"] == str(number)
    assert events.names() == [EVENT_RECORDING_STARTED] * 5 + [EVENT_RECORDING_ENDED]
    assert events.told[1][1] == "flight-000002.mcap, after flight-000001.mcap"
    assert events.told[-1][1] == "flight-000001.mcap to flight-000005.mcap: 300 frames"


def test_a_file_ends_before_its_index_outgrows_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(file, "_MAX_CHUNKS", 2)
    made = recorder(tmp_path)
    made.start()
    units = feed(made, range(100), 30_000)
    made.stop()
    assert len(files(tmp_path)) > 2 and video(*files(tmp_path)) == units


def test_a_stream_without_idrs_is_asked_for_one_and_bounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run, "OVERRUN_BYTES", 500_000)
    asked: list[int] = []
    made = recorder(tmp_path, force_idr=lambda: asked.append(1), max_file_MB=1)
    made.start()
    feed(made, [0], 20_000)
    for k in range(1, 201):  # one P frame after the other
        made.unit(info(k), unit(1, 20_000))
        made.message("battery", BATTERY)
    eventually(lambda: made.dropped)
    assert len(asked) > 1
    feed(made, range(210, 220))
    made.stop()
    first, second = files(tmp_path)
    assert first.stat().st_size <= 1_600_000 and sequences(second) == list(range(210, 220))
    assert len(sequences(first)) + made.dropped == 201


def test_start_stop_and_units_after_the_end(tmp_path: Path) -> None:
    made = recorder(tmp_path)
    feed(made, range(5))
    assert made.stop() == "" and files(tmp_path) == []
    for first in (0, 10):
        made.start()
        feed(made, range(first, first + 10))
        made.stop()
        feed(made, range(50, 60))
    made.close()
    made.close()
    feed(made, range(20))
    made.message("battery", BATTERY)
    with pytest.raises(RecordingError, match="the recorder is closed"):
        made.start()
    assert [sequences(path) for path in files(tmp_path)] == [[*range(10)], [*range(10, 20)]]


def test_a_clock_that_is_set_begins_a_file_so_that_times_in_each_rise(tmp_path: Path) -> None:
    """A board that believes it is 1970 is told the time while it records."""
    made = recorder(tmp_path, events := Events())
    made.start()
    boot_ns, hour_ns = 60_000_000_000, 3_600_000_000_000
    times = [boot_ns + k * PERIOD_NS for k in range(20)]
    times += [START_NS + k * PERIOD_NS for k in range(20, 43)]
    times += [START_NS + k * PERIOD_NS - hour_ns for k in range(43, 60)]
    for k, time_ns in enumerate(times):
        if k == 20:  # the gate tells of a frame before the encoder has it
            made.message("gate", messages.Battery(time_ns=time_ns, voltage=1.0))
        made.unit(info(k, time_ns), unit(k))
    made.stop()
    paths = files(tmp_path)
    assert [sequences(path) for path in paths] == [[*range(20)], [*range(20, 43)], [*range(50, 60)]]
    for path in paths:
        recorded = [sample.time_ns for sample in RecordingReader(path).video()]
        assert recorded == sorted(set(recorded))
    assert made.dropped == 7  # 43 to 49: neither the one file's clock nor an IDR of the next
    assert events.names().count(EVENT_RECORDING_ENDED) == 1
    assert [len(list(RecordingReader(path).json("/blimp/gate"))) for path in paths] == [0, 1, 0]


def test_a_replay_keeps_its_own_times_and_telemetry_lies_beside_them(tmp_path: Path) -> None:
    made = recorder(tmp_path)
    made.start()
    now_ns = time.time_ns()
    flown = info(0)
    made.unit(type(flown)(**{**vars(flown), "clock_ns": now_ns}), unit(0))
    made.message("battery", messages.Battery(time_ns=now_ns + 1000, voltage=3.9))
    reader = RecordingReader(tmp_path / made.stop())
    assert [sample.time_ns for sample in reader.video()] == [START_NS]
    ((logged_ns, value),) = reader.json("/blimp/battery")
    assert logged_ns == START_NS + 1000 and value["time_ns"] == now_ns + 1000


def test_nonsense_from_a_sensor_ends_no_recording(tmp_path: Path) -> None:
    made = recorder(tmp_path)
    made.start()
    feed(made, range(10))
    made.message("battery", messages.Battery(time_ns=START_NS, voltage=math.nan))
    made.message("battery", messages.Battery(time_ns=-(10**19), voltage=3.0))
    made.message("battery", object())  # type: ignore[arg-type]
    made.unit(None, None)  # type: ignore[arg-type]
    flown = info(10)
    made.unit(type(flown)(**{**vars(flown), "exposure_s": math.inf, "gain": None}), unit(10))
    made.unit(info(11, time_ns=-1), unit(11))
    reader = RecordingReader(tmp_path / made.stop())
    assert [value for _, value in reader.json("/camera/frame")][-1] == {"sequence": 10}
    assert len(list(reader.video())) == 11 and list(reader.json("/blimp/battery")) == []
    assert made.dropped == 1 and not reader.cut


def test_a_failing_link_or_encoder_ends_no_recording(tmp_path: Path) -> None:
    def fails(*_: str) -> None:
        raise RuntimeError("no link")

    made = recorder(tmp_path, fails, force_idr=fails, max_file_MB=1)
    made.start()
    units = feed(made, range(100), 15_000)
    made.stop()
    assert video(*files(tmp_path)) == units


@pytest.mark.parametrize("decoder", DECODERS)
def test_each_decoder_plays_the_same_pictures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, decoder: str
) -> None:
    """H.264 says each bit of a picture, so that a card's decoder gives what a desk's does."""
    if gstreamer.load().ElementFactory.find(decoder) is None:
        pytest.skip(f"GStreamer has no '{decoder}' here")
    made = recorder(tmp_path)
    made.start()
    feed(made, range(40))
    path = tmp_path / made.stop()

    def played(*names: str) -> list[tuple[int, bytes]]:
        monkeypatch.setattr(decoding, "DECODERS", names)
        with contextlib.closing(RecordingDecoder(path)) as one:
            pictures = list(one.pictures())
        return [(p.time_ns, p.buffer.extract_dup(0, p.buffer.get_size())) for p in pictures]

    first = played("avdec_h264")
    assert len(first) == 40 and len({data for _, data in first}) == 40
    assert played("of nobody", decoder) == first


def test_a_machine_without_a_decoder_is_told_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(decoding, "DECODERS", ("avdec_none", "openh264none"))
    with pytest.raises(StreamError, match=r"replay of .*a\.mcap: .* no element 'avdec_none'"):
        RecordingDecoder(tmp_path / "a.mcap")


def test_replay_and_ground_station_read_it(tmp_path: Path) -> None:
    made = recorder(tmp_path)
    made.start()
    feed(made, range(40))
    path = tmp_path / made.stop()
    decoder = RecordingDecoder(path)
    pictures = list(decoder.pictures())
    decoder.close()
    assert [(p.time_ns, p.exposure_s, p.gain) for p in pictures] == [
        (info(k).time_ns, info(k).exposure_s, 2.0) for k in range(40)
    ]
    source = open_input(path)
    frames = list(source)
    assert source.camera is None and source.notes == [] and source.count() == 40
    assert [number_in(frame.image) for frame in frames] == list(range(40))
    assert [(f.time_ns, f.exposure_s) for f in frames] == [
        (info(k).time_ns, info(k).exposure_s) for k in range(40)
    ]
    flown = fly(
        {
            "camera.uri": f"replay:{path}?pace=stepped",
            "camera.width_px": 160,
            "camera.height_px": 120,
            "gate.enabled": False,
        }
    )
    assert flown.status == 0 and flown.sequences == list(range(40)), flown.err


def test_a_payload_that_only_streams_loads_no_writer(tmp_path: Path) -> None:
    code = f"""
import sys
from pi_firmware import gstreamer
from pi_firmware.recording import Recorder
from pi_firmware.settings import RecordingSettings
heavy = lambda: sorted({{"mcap", "google.protobuf", "zstandard", "lz4"}} & set(sys.modules))
made = Recorder(RecordingSettings(folder={str(tmp_path)!r}, min_free_MB=0), print)
made.unit(None, b"")
made.message("battery", None)
made.stop()
print(heavy())
made.start()
print(bool(heavy()))
made.close()
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    lines = done.stdout.splitlines()
    assert lines[0] == "[]" and "True" in lines


def test_memory_does_not_grow_with_what_was_recorded(tmp_path: Path) -> None:
    made = recorder(tmp_path, max_file_MB=2, max_total_MB=5)
    made.start()
    taken = []
    tracemalloc.start()
    try:
        for block in range(4):
            feed(made, range(block * 300, block * 300 + 300), 15_000)
            eventually(lambda: made._run is not None and not made._run.queue._items)
            taken.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    made.stop()
    assert made.dropped == 0 and video(*files(tmp_path))[-1] == unit(1199, 15_000)
    assert taken[3] - taken[1] < 400_000  # of 9 MB recorded; a chunk in progress has up to 256 KB
