"""The ground's recordings: whole after SIGKILL, readable by others, bounded, of all payloads."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from intake_stand import (
    CAMERA,
    GOP,
    ROUND,
    Stand,
    capture_ns,
    encoded,
    eventually,
    number_in,
    stamped,
)
from mcap.reader import make_reader
from mcap_doctor import complaints

from ground_station.geometry.camera import Camera, load_camera
from ground_station.recording.flight import trajectory_of
from ground_station.recording.open import open_input
from ground_station.service import bus_messages
from ground_station.service.bus_messages import EstimateMessage, EventMessage, PayloadMessage
from ground_station.service.intake import files as files_module
from ground_station.service.intake.recording import GroundRecorder
from ground_station.service.settings import RecordingSettings
from ground_station.service.web.recordings import Recordings
from ground_station.stream.assembly import ReceivedFrame
from pi_firmware.wire import annexb, keys, messages
from pi_firmware.wire.errors import RecordingError
from pi_firmware.wire.recording import (
    CALIBRATION_TOPIC,
    ESTIMATE_TOPIC,
    FRAME_INFO_TOPIC,
    VIDEO_TOPIC,
    RecordingReader,
)

GROUND_NS = 1_800_000_000_000_000_000
DATED = r"flight-000001-20\d{6}T\d{6}Z\.mcap"
IMAGE = np.zeros((480, 640), np.uint8)


def recorded(folder: Path) -> list[Path]:
    return sorted(folder.glob("flight-*.mcap"))


def frame(index: int, padding_bytes: int = 0) -> ReceivedFrame:
    """Frame `index` of the numbered flight as the receiver gives it."""
    unit = stamped(encoded(ROUND)[index % ROUND], index)
    if padding_bytes:
        unit += annexb.START_CODE + b"\x0c" + b"\xff" * padding_bytes + b"\x80"
    return ReceivedFrame(
        image=IMAGE, sequence=index, time_ns=capture_ns(index), clock_ns=capture_ns(index),
        arrival_ns=GROUND_NS, entropy_bits=7.0, sharpness=1.0, exposure_s=0.01, gain=1.0,
        heartbeat=False, ssrc=1, access_unit=unit,
    )  # fmt: skip


def log_ns(index: int) -> int:
    """When frame `index` was captured, by the ground's clock."""
    return GROUND_NS + index * 33_333_333


class Events:
    def __init__(self) -> None:
        self.told: list[tuple[str, str, str]] = []

    def __call__(self, name: str, level: str, text: str) -> None:
        self.told.append((name, level, text))


def recorder(
    folder: Path, events: Events | None = None, camera: Camera | None = None, **settings: object
) -> GroundRecorder:
    values = {"folder": str(folder), "min_free_MB": 0, **settings}
    return GroundRecorder(RecordingSettings(**values), events or Events(), camera=camera)


def sequences(path: Path, prefix: str = "") -> list[int]:
    return [value["sequence"] for _, value in RecordingReader(path).json(prefix + FRAME_INFO_TOPIC)]


def estimate(index: int, **more: object) -> EstimateMessage:
    note = EstimateMessage(
        sequence=index, time_ns=capture_ns(index), clock_ns=capture_ns(index),
        capture_ns=log_ns(index), done_ns=log_ns(index) + 5, state="TRACKING",
        position_m=[1.0 * index, 2.0, 3.0], quaternion_xyzw=[0.0, 0.0, 0.0, 1.0],
        covariance=[0.5] * 36, points_px=[1.0, 2.0] * 300,
    )  # fmt: skip
    return replace(note, **more)  # type: ignore[arg-type]


def opened_by_others(path: Path) -> dict[str, int]:
    """`mcap doctor`, MCAP's own reader with CRCs checked, and Foxglove's message types."""
    assert complaints(path) == []
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        kinds: dict[str, int] = {}
        for schema, _, message in reader.iter_messages(log_time_order=False):
            assert schema is not None
            kinds[schema.name] = kinds.get(schema.name, 0) + 1
            if schema.name == "foxglove.CompressedVideo":
                video = CompressedVideo.FromString(message.data)
                assert video.format == "h264" and video.frame_id == "camera"
            if schema.name == "foxglove.PoseInFrame":
                assert PoseInFrame.FromString(message.data).frame_id == "world"
        assert summary.statistics.message_count == sum(kinds.values())
    return kinds


def test_a_recording_holds_all_that_was_said_on_the_grounds_clock(tmp_path: Path) -> None:
    (tmp_path / "camera.toml").write_text(CAMERA)
    camera = load_camera(tmp_path / "camera.toml")
    made = recorder(tmp_path / "out", events := Events(), camera)
    made.start()
    battery = messages.Battery(time_ns=5, voltage=3.9)
    for k in range(30):
        made.frame("blimp-1", frame(k), log_ns(k))
        made.estimate("blimp-1", estimate(k, map="hall" if k < 15 else "atrium"))
    made.estimate("blimp-1", estimate(30, position_m=None, quaternion_xyzw=None, state="LOST"))
    made.message("blimp-1", keys.BATTERY, battery)
    made.note(bus_messages.EVENT, "-", EventMessage(1, "web", "info", "hello", "there"))
    made.close()
    (path,) = recorded(tmp_path / "out")
    (told,) = Recordings(tmp_path / "out", lambda: "").list()
    assert told["maps"] == ["atrium", "hall"] and told["file"] == path.name
    kinds = opened_by_others(path)
    assert kinds["foxglove.CompressedVideo"] == kinds["foxglove.PoseInFrame"] == 30
    reader = RecordingReader(path)
    video = list(reader.messages({VIDEO_TOPIC}))
    assert [record.log_time for _, record in video] == [log_ns(k) for k in range(30)]
    assert [sample.time_ns for sample in reader.video()] == [capture_ns(k) for k in range(30)]
    assert [sample.data for sample in reader.video()] == [frame(k).access_unit for k in range(30)]
    assert not reader.cut and reader.metadata["payload"]["payload_id"] == "blimp-1"
    poses = reader.poses(ESTIMATE_TOPIC)
    assert [pose.time_ns for pose in poses] == [capture_ns(k) for k in range(30)]
    assert trajectory_of(path, ESTIMATE_TOPIC).position_m[7].tolist() == [7.0, 2.0, 3.0]
    states = list(reader.json("/estimate/state"))
    assert states[0][0] == log_ns(0) and states[0][1]["covariance"] == [0.5] * 36
    assert "points_px" not in states[0][1] and states[30][1]["state"] == "LOST"
    ((_, told),) = reader.json("/blimp/blimp-1/battery")
    assert told == json.loads(messages.encode(battery))
    ((_, event),) = reader.json("/station/event")
    assert event["text"] == "there"
    # The reader of `blimp localize`: camera, capture times and pictures.
    source = open_input(path)
    assert source.camera == camera
    frames = list(source)
    assert [number_in(f.image) for f in frames] == list(range(30)) and source.notes == []
    assert [f.time_ns for f in frames] == [capture_ns(k) for k in range(30)]
    assert [name for name, _, _ in events.told] == ["recording-started", "recording-ended"]
    assert {level for _, level, _ in events.told} == {"info"}


def test_damaged_frames_are_told_and_their_video_is_left_out(tmp_path: Path) -> None:
    made = recorder(tmp_path)
    made.start()
    part = np.zeros((30, 40), bool)
    for k in range(GOP + 5):
        hit = 5 <= k < GOP
        made.frame("blimp-1", replace(frame(k), damaged=part if hit else None), log_ns(k))
        made.estimate("blimp-1", estimate(k, damaged=0.25 if hit else 0.0))
    for damaged, withheld in ((3, 1), (13, 4), (1, 1), (4, 2)):  # the third: a session begins
        counts = {"damaged": damaged, "withheld": withheld, "received": 100}
        made.note("payload", "blimp-1", PayloadMessage(True, 1, frames=counts))
    made.close()
    (path,) = recorded(tmp_path)
    whole = [*range(5), *range(GOP, GOP + 5)]
    assert sequences(path) == whole
    assert [number_in(f.image) for f in open_input(path)] == whole
    (listed,) = Recordings(tmp_path, lambda: "").list()
    assert listed["lacks"] == {"damaged": 14, "withheld": 5, "lost": 0}
    told = [state["damaged"] for _, state in RecordingReader(path).json("/estimate/state")]
    assert told == [0.25 if 5 <= k < GOP else 0.0 for k in range(GOP + 5)]


def test_each_payload_has_its_own_topics(tmp_path: Path) -> None:
    made = recorder(tmp_path, camera=Camera())
    made.start()
    for k in range(30):
        made.frame("blimp-2", frame(k), log_ns(k))
        if k >= 5:
            made.frame("blimp-1", frame(k), log_ns(k))
        made.estimate("blimp-1", estimate(k))
    made.close()
    assert [complaints(path) for path in recorded(tmp_path)] == [[]]
    (path,) = recorded(tmp_path)
    reader = RecordingReader(path)
    assert sequences(path) == list(range(30))
    assert sequences(path, "/blimp-1") == list(range(GOP, 30))  # from its first IDR on
    assert reader.calibration() is not None
    assert reader.calibration("/blimp-1" + CALIBRATION_TOPIC) is not None
    assert {p.position_m[0] for p in reader.poses("/blimp-1" + ESTIMATE_TOPIC)} <= {*range(30)}
    assert reader.metadata["payload blimp-1"] == {"payload_id": "blimp-1", "topics": "/blimp-1"}


def test_a_full_file_goes_on_in_the_next_and_no_stream_loses_a_frame(tmp_path: Path) -> None:
    made = recorder(tmp_path, max_file_MB=1)
    made.start()
    for k in range(300):
        made.frame("blimp-1", frame(k, 10_000), log_ns(k))
        made.frame("blimp-2", frame(k + 7, 2_000), log_ns(k))  # its IDRs come at other times
    made.close()
    assert not any(complaints(path) for path in recorded(tmp_path))
    paths = recorded(tmp_path)
    assert len(paths) > 3 and made.dropped == 0
    both = (("", 0), ("/blimp-2", GOP))
    for prefix, first in both:
        assert [n for path in paths for n in sequences(path, prefix)] == [
            *range(first, 300 + (7 if prefix else 0))
        ]
    for path in paths:
        reader = RecordingReader(path)
        for prefix, _ in both:
            units = [sample.data for sample in reader.video(prefix + VIDEO_TOPIC)]
            assert not units or annexb.is_idr(units[0])
        assert not reader.cut and path.stat().st_size < 2_000_000
        assert reader.metadata["payload blimp-2"]["topics"] == "/blimp-2"


def test_a_file_ends_at_its_age(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = recorder(tmp_path, max_file_s=10.0)
    now_s = [0.0]
    monkeypatch.setattr(files_module, "time", SimpleNamespace(monotonic=lambda: now_s[0]))
    made.start()
    name = made.file
    for first in range(0, 60, GOP):
        for k in range(first, first + GOP):
            made.frame("blimp-1", frame(k), log_ns(k))
        run = made._run
        assert run is not None
        eventually(lambda: not run.queue._items)  # noqa: B023
        now_s[0] += 4.5
    assert made.file != name
    made.close()
    paths = recorded(tmp_path)
    assert len(paths) == 2 and [n for path in paths for n in sequences(path)] == [*range(60)]
    assert sequences(paths[1])[0] == 3 * GOP  # the first IDR after 10 s, of one each 4.5 s


def test_a_disk_without_room_is_a_reason_and_an_alarm(tmp_path: Path) -> None:
    made = recorder(tmp_path, events := Events(), min_free_MB=10_000_000)
    with pytest.raises(RecordingError, match="min_free_MB"):
        made.start()
    assert made.state().active is False
    made.close()
    made = recorder(tmp_path, events)
    made.start()
    made.frame("blimp-1", frame(0), log_ns(0))
    path = tmp_path / made.file
    path.unlink()  # a file that somebody deletes is no place for more
    eventually(lambda: not made.file)
    assert "deleted" in made.state().problem
    eventually(lambda: events.told[-1][0] == "recording-ended")
    assert events.told[-1][1] == bus_messages.ALARM
    assert made.start() and made.state().problem == ""
    made.close()


def test_sigkill_while_recording_costs_at_most_a_second(tmp_path: Path) -> None:
    with Stand(tmp_path) as stand:
        stand.payload("blimp-1")
        stand.heard.more(10, "blimp-1")
        started = stand.ask(do="record-start")
        assert started["done"] and re.fullmatch(DATED, started["file"])
        assert stand.ask(do="record-start")["file"] == started["file"]
        eventually(lambda: stand.heard.recording[-1].duration_s > 4)
        stand.process.kill()
        stand.process.wait()
        (path,) = recorded(stand.recordings)
        reader = RecordingReader(path)
        reader.topics()
        assert reader.cut
        kept = sequences(path)
        # Each frame that was shown a second before the end is there (and a second more for a
        # busy machine), as is every one between it and the first.
        shown = {note.sequence: note.arrival_ns for note, _ in stand.heard.of("blimp-1")}
        last_ns = max(shown.values())
        assert kept == list(range(kept[0], kept[-1] + 1))
        missing = [last_ns - at_ns for number, at_ns in shown.items() if number > kept[-1]]
        assert max(missing, default=0) < 2e9
        pictures = list(open_input(path))
        assert [number_in(f.image) for f in pictures] == [number % ROUND for number in kept]
        # And the next process goes on behind it.
        before = len(stand.heard.recording)
        stand.start()
        eventually(lambda: any(note.active for note in stand.heard.recording[before:]))
        assert stand.heard.recording[-1].file.startswith("flight-000002-2")


def test_sigterm_ends_the_recording_in_order(tmp_path: Path) -> None:
    with Stand(tmp_path, recording={"at_start": True}) as stand:
        payload = stand.payload("blimp-1")
        eventually(lambda: stand.heard.recording and stand.heard.recording[-1].active)
        stand.heard.more(60, "blimp-1")
        note = stand.heard.recording[-1]
        assert re.fullmatch(DATED, note.file) and note.free_MB and note.problem == ""
        ended = payload.end().counts
        stand.settled("blimp-1", ended)
        asked_s = time.monotonic()
        stand.process.terminate()
        assert stand.process.wait(20) == 0
        assert time.monotonic() - asked_s < 10  # 5 s are promised
        assert stand.written() == ""
        (path,) = recorded(stand.recordings)
        reader = RecordingReader(path)
        counts = reader.topics()
        assert not reader.cut and counts[VIDEO_TOPIC] == ended["sent"]
        assert reader.metadata["recording_end"] == {
            "frames": str(ended["sent"]), "left_out": "0",
            "damaged": "0", "withheld": "0", "lost": "0",
        }  # fmt: skip
        for kind in (keys.BATTERY, keys.HEALTH, keys.GATE, keys.EVENT):
            assert counts[f"/blimp/blimp-1/{kind}"]
        # The first ones may be said before anyone is connected: a gate's message waits for nobody.
        assert 0.8 * ended["captured"] < counts["/blimp/blimp-1/gate"] <= ended["captured"]
        assert counts["/station/blimp-1/payload"] > 3
        camera = open_input(path).camera
        assert camera is not None and camera.k1 == 0.1673


def test_blimp_record_records_without_the_service(tmp_path: Path) -> None:
    with Stand(tmp_path, served=False) as stand:
        command = [
            sys.executable, "-m", "ground_station.cli", "record", "--out", str(tmp_path / "out"),
            "--port", str(stand.port), "--seconds", "99", "--camera", str(tmp_path / "camera.toml"),
            "--set", f'telemetry.listen=["{stand.endpoint}"]', "--set", "recording.min_free_MB=0",
        ]  # fmt: skip
        said = tmp_path / "said.txt"
        with said.open("w") as out, subprocess.Popen(command, stdout=out) as recording:
            eventually(lambda: "recording-started" in said.read_text())
            payload = stand.payload("blimp-1")
            eventually(lambda: "ssrc" in payload.written())
            time.sleep(1)
            ended = payload.end().counts
            eventually(lambda: "payload-gone" in said.read_text())
            recording.terminate()
            assert recording.wait(60) == 0
        assert f"{ended['sent']} sent" in said.read_text()
        (path,) = recorded(tmp_path / "out")
        assert sequences(path) == list(range(ended["sent"]))
        command[command.index("99")] = "0.2"  # nobody flies: it ends by itself, and says so
        assert subprocess.run(command, capture_output=True, timeout=60, check=False).returncode == 1
