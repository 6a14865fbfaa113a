"""A recording's poses come out as they went in, at the camera's times."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np
import pytest

from ground_station.cli import main
from ground_station.errors import InputError
from ground_station.geometry.trajectory import read_tum
from ground_station.recording.export import AGAIN, HEADER, read_poses, tum
from ground_station.recording.flight import trajectory_of
from pi_firmware.wire.errors import RecordingError
from pi_firmware.wire.recording import (
    ESTIMATE_TOPIC,
    TRUTH_TOPIC,
    RecordingReader,
    RecordingWriter,
)

FLIGHT = Path(__file__).parents[2] / "maps" / "atrium" / "flight.mcap"
OURS = f"/blimp-1{ESTIMATE_TOPIC}"
UPRIGHT = (0.0, 0.0, 0.0, 1.0)


def record(path: Path, topics: dict[str, Iterable[tuple[int, float]]]) -> Path:
    """A recording with poses at (time, x) on each topic."""
    with RecordingWriter(path) as writer:
        writer.write_json("/blimp-1/battery", 1, {"voltage_V": 4.0}, schema_name="battery")
        for topic, samples in topics.items():
            for time_ns, x_m in samples:
                writer.write_pose(time_ns, (x_m, 2.0, 3.0), UPRIGHT, topic=topic)
    return path


def tum_lines(path: Path, topic: str | None = None) -> Iterator[str]:
    return tum(read_poses(path, topic))


Blimp = Callable[..., tuple[int, str, str]]


@pytest.fixture
def blimp(capsys: pytest.CaptureFixture[str]) -> Blimp:
    """`blimp export` with these arguments: its status, output and errors."""

    def run(*arguments: object) -> tuple[int, str, str]:
        return main(["export", *map(str, arguments)]), *capsys.readouterr()

    return run


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    return record(tmp_path / "flight.mcap", {OURS: [(1_500_000_001, 1.0), (1_600_000_000, 1.25)]})


def test_lines_are_those_of_tum(flight: Path) -> None:
    lines = list(tum_lines(flight))
    assert lines == [
        HEADER,
        "1.500000001 1.000000000 2.000000000 3.000000000 "
        "0.000000000 0.000000000 0.000000000 1.000000000\n",
        "1.600000000 1.250000000 2.000000000 3.000000000 "
        "0.000000000 0.000000000 0.000000000 1.000000000\n",
    ]


def test_a_flights_poses_are_read_back_exactly(blimp: Blimp, tmp_path: Path) -> None:
    out = tmp_path / "truth.txt"
    status, said_out, said_err = blimp(FLIGHT, "--topic", TRUTH_TOPIC, "--out", out)
    assert status == 0 and said_err == ""
    truth, read = trajectory_of(FLIGHT), read_tum(out)
    said = f"{len(truth)} poses of /truth/pose -> {out}"
    after = f"next: blimp evaluate {out} TRUTH.txt    (where you have the truth)"
    assert said_out.splitlines() == [said, after]
    assert (read.time_ns == truth.time_ns).all()
    assert np.abs(read.position_m - truth.position_m).max() < 1e-9
    assert np.abs(read.quaternion_xyzw - truth.quaternion_xyzw).max() < 1e-8


def test_mcap_has_the_poses_and_nothing_else(blimp: Blimp, flight: Path, tmp_path: Path) -> None:
    out = tmp_path / "poses.mcap"
    assert blimp(flight, "--format", "mcap", "--out", out)[0] == 0
    reader = RecordingReader(out)
    assert reader.topics() == {OURS: 2} and not reader.cut
    assert reader.poses(OURS) == RecordingReader(flight).poses(OURS)
    assert reader.metadata_table("export") == {"source": "flight.mcap", "topic": OURS}
    assert list(tmp_path.glob("*.part")) == []


def test_times_are_the_cameras_and_not_the_logs(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "f.mcap") as writer:
        writer.write_pose(5_000_000_000, (1, 2, 3), UPRIGHT, topic=OURS, log_ns=1 << 60)
    assert list(tum_lines(tmp_path / "f.mcap"))[1].startswith("5.000000000 ")


def test_a_camera_whose_time_begins_again_is_told(blimp: Blimp, tmp_path: Path) -> None:
    samples = [(10, 1.0), (20, 2.0), (10, 3.0), (20, 4.0)]
    path = record(tmp_path / "f.mcap", {OURS: samples})
    lines = list(tum_lines(path))
    assert [line[0] for line in lines] == ["#", "0", "0", "#", "0", "0"] and lines[3] == AGAIN
    status, _, said = blimp(path, "--out", tmp_path / "est.txt")
    assert status == 0 and "the camera's time begins again 1 times" in said


def test_of_several_payloads_one_must_be_chosen(tmp_path: Path) -> None:
    other = f"/blimp-2{ESTIMATE_TOPIC}"
    path = record(tmp_path / "f.mcap", {OURS: [(1, 1.0)], other: [(1, 7.0)]})
    with pytest.raises(InputError, match=f"poses on {OURS}, {other}; say which by --topic"):
        tum_lines(path)
    assert " 7.000000000 " in list(tum_lines(path, other))[1]


@pytest.mark.parametrize("bad", [(-1, 1.0), (5, float("nan")), (5, float("inf"))])
def test_what_is_no_pose_is_left_out_and_counted(
    bad: tuple[int, float], blimp: Blimp, tmp_path: Path
) -> None:
    path = tmp_path / "f.mcap"
    with RecordingWriter(path) as writer:
        for time_ns, x_m in ((1, 1.0), bad, (9, 2.0)):
            writer.write_pose(time_ns, (x_m, 2, 3), UPRIGHT, topic=OURS, log_ns=1)
        writer.write_pose(10, (1, 2, 3), (0, 0, 0, 0), topic=OURS)
    lines = list(tum_lines(path))
    assert len(lines) == 4 and lines[-1] == "# 2 left out: no finite pose or time\n"
    status, _, said = blimp(path, "--out", tmp_path / "est.txt")
    assert status == 0 and "2 left out: no finite pose or time" in said
    assert len(read_tum(tmp_path / "est.txt")) == 2


def test_a_cut_recording_gives_what_is_whole(blimp: Blimp, tmp_path: Path) -> None:
    path = tmp_path / "f.mcap"
    with RecordingWriter(path, chunk_bytes=1000) as writer:
        for k in range(200):
            writer.write_pose(k, (k, 2, 3), UPRIGHT, topic=OURS)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    status, _, said = blimp(path, "--out", tmp_path / "est.txt")
    assert status == 0 and "cut (" in said
    assert 50 < len(read_tum(tmp_path / "est.txt")) < 150
    assert list(tum_lines(path))[-1].startswith("# the recording is cut: ")


def test_errors_are_told_before_the_first_line(flight: Path, tmp_path: Path) -> None:
    empty = record(tmp_path / "empty.mcap", {})
    for path, topic, kind in (
        (tmp_path / "absent.mcap", None, RecordingError),
        (empty, None, InputError),
        (empty, OURS, InputError),
        (flight, "/blimp-1/battery", RecordingError),
    ):
        with pytest.raises(kind) as told:
            tum_lines(path, topic)
        assert str(path) in str(told.value) and "\n" not in str(told.value)


def test_the_command_refuses_in_one_line_and_spares_the_recording(
    blimp: Blimp, flight: Path, tmp_path: Path
) -> None:
    before = flight.read_bytes()
    for arguments in (
        (flight, "--format", "mcap", "--out", flight),
        (flight, "--out", flight),
        (flight, "--out", tmp_path / "none" / "est.txt"),
        (flight, "--topic", "/blimp-1/battery", "--out", tmp_path / "est.txt"),
        (tmp_path / "absent.mcap", "--out", tmp_path / "est.txt"),
        (flight, "--format", "mcap", "--out", tmp_path),
    ):
        status, out, said = blimp(*arguments)
        assert status == 2 and out == ""
        assert said.startswith("blimp export: ") and said.count("\n") == 1
    assert flight.read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["flight.mcap"]
