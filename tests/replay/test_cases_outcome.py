"""A run's folder: what is read is what was written, bit for bit, and damage is told in one line."""

from __future__ import annotations

import dataclasses
import json
import os
import tempfile
import time
from pathlib import Path

import cases_stand as stand
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ground_station.geometry.trajectory import read_tum
from ground_station.map.floorplan import FloorPlan
from ground_station.replay.cases import frames
from ground_station.replay.cases.frames import first_difference
from ground_station.replay.cases.outcome import (
    FRAMES,
    RESULT,
    Outage,
    Outcome,
    read_outcome,
    write_outcome,
)
from ground_station.replay.resources import Watch
from pi_firmware.wire.errors import BlimpError

ROWS = [
    stand.row(0, state="INITIALIZING", wTc=None, reason='no "map", yet\nnor line'),
    stand.off(1, 0.25, relocalized=True, state="DEGRADED", reason="few inliers"),
    stand.row(2, captured_ns=frames.UNKNOWN),
    stand.row(3, wTc=np.full((4, 4), np.nan)),
]


def bits(table: frames.Frames) -> list[bytes]:
    """Every number of a table as it is in memory."""
    columns = [getattr(table, item.name) for item in dataclasses.fields(table)]
    return [c.tobytes() for c in columns if isinstance(c, np.ndarray)]


def with_cells(path: Path, first: int, *texts: str) -> None:
    """Writes a table of three frames, of whose second these cells are another's."""
    frames.write_csv(path, stand.table([stand.row(k) for k in range(3)]))
    lines = path.read_text().splitlines()
    cells = lines[2].split(",")
    cells[first : first + len(texts)] = texts
    lines[2] = ",".join(cells)
    path.write_text("\n".join(lines) + "\n")


def test_a_folder_reads_back_as_it_was(tmp_path: Path) -> None:
    plan = FloorPlan(np.arange(48, dtype=np.uint8).reshape(6, 8), 0.5, (1.0, -2.0, 0.25))
    outage = Outage(stand.CLOCK_NS, stand.CLOCK_NS + 5, "gone")
    made = dataclasses.replace(stand.outcome(ROWS, outages=[outage]), floorplan=plan)
    write_outcome(tmp_path / "run", made)
    read = read_outcome(tmp_path / "run")
    assert read.run == made.run and bits(read.frames) == bits(made.frames)
    assert read.frames.digest == made.frames.digest and read.frames.state == made.frames.state
    assert read.frames.reason[0] == 'no "map", yet nor line'
    assert read.run.outages == [outage] and read.run.payload_side.memory_MB == 80.0
    assert read.truth is not None and len(read.truth) == 4
    assert read.floorplan is not None and read.floorplan.origin == plan.origin
    assert (read.floorplan.image == plan.image).all()
    assert len(read_tum(tmp_path / "run" / "estimate.txt")) == 2  # the finite ones
    assert not list((tmp_path / "run").glob("*.part"))


def test_what_replay_wrote_around_an_outcome_is_one(tmp_path: Path) -> None:
    write_outcome(tmp_path / "outcome", stand.outcome())
    assert len(read_outcome(tmp_path).frames) == 60


def test_a_run_without_frames_is_one(tmp_path: Path) -> None:
    write_outcome(tmp_path, stand.outcome([]))
    read = read_outcome(tmp_path)
    assert len(read.frames) == 0 and read.truth is None and not len(read.estimate)


@settings(deadline=None, max_examples=30)
@given(
    st.lists(
        st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=3, max_size=3),
        min_size=1, max_size=5,
    )
)  # fmt: skip
def test_every_bit_of_a_position_survives_the_file(positions: list[list[float]]) -> None:
    rows = []
    for k, position in enumerate(positions):
        wTc = np.eye(4)
        wTc[:3, 3] = position
        rows.append(stand.row(k, wTc=wTc))
    made = stand.table(rows)
    with tempfile.TemporaryDirectory() as folder:
        frames.write_csv(Path(folder, "frames.csv"), made)
        read = frames.read_csv(Path(folder, "frames.csv"))
    both = (made.position_m, read.position_m)
    known = [~np.isnan(p) for p in both]
    assert (known[0] == known[1]).all()
    assert both[0][known[0]].tobytes() == both[1][known[0]].tobytes()
    assert first_difference(made, read).count == 0


def test_the_smallest_change_of_a_pose_is_another_pose() -> None:
    wTc = stand.true_pose(3)
    other = wTc.copy()
    other[0, 1] = np.nextafter(other[0, 1], 1.0)
    assert frames.digest(wTc) == frames.digest(wTc.copy()) != frames.digest(other)
    found = first_difference(
        stand.table([stand.row(k) for k in range(5)]),
        stand.table([stand.row(k, wTc=other if k == 3 else stand.true_pose(k)) for k in range(5)]),
    )
    assert found.count == 1 and found.time_ns == stand.START_NS + 3 * stand.STEP_NS
    assert "frame 3 is 0 m off" in found.told  # not a nanometre: the bits say it


@pytest.mark.parametrize(
    ("column", "text", "says"),
    [
        (0, "x", "line 3"),
        (1, str(2**63), "not between 0 and 2^63"),
        (4, "-2", "not between 0 and 2^63"),
        (5, "FLYING", "the state is 'FLYING'"),
        (7, "2", "relocalized is '2'"),
        (9, "1,5", "columns"),
        (9, "one", "line 3"),
        (15, "", "a pose without its digest"),
        (15, "xyz", "pose_sha256 is 'xyz'"),
    ],
)
def test_a_damaged_table_is_refused_by_its_line(
    tmp_path: Path, column: int, text: str, says: str
) -> None:
    path = tmp_path / "frames.csv"
    with_cells(path, column, text)
    with pytest.raises(BlimpError) as error:
        frames.read_csv(path)
    assert says in str(error.value) and "line 3" in str(error.value)
    assert "\n" not in str(error.value)


def test_a_table_cut_anywhere_is_refused_or_shorter(tmp_path: Path) -> None:
    path = tmp_path / "frames.csv"
    frames.write_csv(path, stand.table([stand.row(k) for k in range(3)]))
    whole = path.read_bytes()
    for size in range(0, len(whole), 7):
        path.write_bytes(whole[:size])
        try:
            assert len(frames.read_csv(path)) < 3
        except BlimpError as error:
            assert "\n" not in str(error)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "truncated"),
        (b"[1]", "Expected `object`, got `array`"),
        (b"[" * 100_000, "Expected `object`, got `array`"),
        (b'{"settings": {"a": %s' % (b"[" * 100_000), "recursion"),
        (b'{"seconds": NaN}', "malformed"),
        (b'{"sconds": 1}', "unknown field `sconds`"),
        (b'{"schema": "blimp.outcome/2"}', "Invalid enum value 'blimp.outcome/2'"),
        (b'{"accounts": {"sent": 1.5}}', "Expected `int`, got `float` - at `$.accounts.sent`"),
        (b'{"accounts": {"sent": 1%s}}' % (b"0" * 400), "at `$.accounts.sent`"),
        (b'{"outages": [{"begin_ns": -1}]}', "Expected `int` >= 0 - at `$.outages[0].begin_ns`"),
        (b'{"outages": [3]}', "got `int` - at `$.outages[0]`"),
        (b'{"payload_side": {"memory_MB": "much"}}', "got `str` - at `$.payload_side.memory_MB`"),
        (b'{"battery": {"time_ns": 1}}', "missing required field `voltage` - at `$.battery`"),
    ],
)
def test_a_result_that_is_none_is_refused_in_one_line(
    tmp_path: Path, content: bytes, says: str
) -> None:
    write_outcome(tmp_path, stand.outcome())
    (tmp_path / RESULT).write_bytes(content)
    with pytest.raises(BlimpError) as error:
        read_outcome(tmp_path)
    assert says in str(error.value) and "\n" not in str(error.value)


def test_a_quaternion_that_is_none_is_no_pose(tmp_path: Path) -> None:
    """As another's program, or a flipped bit, may have written it."""
    with_cells(tmp_path / "f.csv", 11, *["0.0"] * 4)
    read = frames.read_csv(tmp_path / "f.csv")
    assert read.finite.tolist() == [True, False, True] and len(read.trajectory()) == 2


def test_a_folder_without_its_last_file_is_no_outcome(tmp_path: Path) -> None:
    """It is written last: a killed program leaves no half of a run."""
    write_outcome(tmp_path, stand.outcome())
    (tmp_path / RESULT).unlink()
    assert (tmp_path / FRAMES).is_file()
    with pytest.raises(BlimpError, match="no run's outcome is there; blimp replay"):
        read_outcome(tmp_path)


def test_numbers_that_json_cannot_say_become_absent(tmp_path: Path) -> None:
    made = stand.outcome(clock_offset={"offset_ns": float("nan")})
    write_outcome(tmp_path, made)
    assert json.loads((tmp_path / RESULT).read_text())["clock_offset"]["offset_ns"] is None
    assert isinstance(read_outcome(tmp_path), Outcome)


def test_a_process_is_watched_for_memory_and_processor_time() -> None:
    with Watch(os.getpid()) as watch:
        block = np.ones(20_000_000, np.uint8)
        until_s = time.process_time() + 0.1
        while time.process_time() < until_s:
            pass
    side = watch.side()
    assert side.memory_MB is not None and side.memory_MB > block.nbytes / 1e6
    assert side.cpu is not None and side.cpu > 0
    with Watch(2**22 + 1) as nobody:
        pass
    assert nobody.side().memory_MB is None and nobody.side().cpu is None
