"""TUM text in and out, and poses between poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ground_station.errors import GeometryError
from ground_station.geometry import poses
from ground_station.geometry.trajectory import Trajectory, read_tum, seconds_to_ns, write_tum

LINE = "1.5 1 2 3 0 0 0 1\n"


def random_trajectory(n: int = 50, seed: int = 1) -> Trajectory:
    rng = np.random.default_rng(seed)
    times = 1_700_000_000_000_000_000 + np.cumsum(rng.integers(1, 10**9, n))
    quaternions = Rotation.random(n, random_state=seed).as_quat()
    return Trajectory(times, rng.uniform(-100, 100, (n, 3)), quaternions)


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    written = random_trajectory()
    write_tum(tmp_path / "t.txt", written)
    read = read_tum(tmp_path / "t.txt")
    np.testing.assert_array_equal(read.time_ns, written.time_ns)  # to the nanosecond
    np.testing.assert_allclose(read.position_m, written.position_m, atol=1e-9)
    np.testing.assert_allclose(read.quaternion_xyzw, written.quaternion_xyzw, atol=2e-9)
    assert not list(tmp_path.glob("*.part"))


@settings(max_examples=200, deadline=None)
@given(st.integers(-(2**61), 2**61))
def test_times_pass_through_text_exactly(time_ns: int) -> None:
    sign, (s, ns) = ("-" if time_ns < 0 else ""), divmod(abs(time_ns), 10**9)
    assert seconds_to_ns(f"{sign}{s}.{ns:09d}") == time_ns


def test_exponents_and_short_fractions_are_read() -> None:
    assert seconds_to_ns("1.305031102175304031e+09") == pytest.approx(1305031102175304031, abs=200)
    assert [seconds_to_ns(t) for t in ("3", "0.5", ".5", "-0.25", "+1.")] == [
        3_000_000_000, 500_000_000, 500_000_000, -250_000_000, 1_000_000_000,
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (LINE + "2.5 1 2 3 0 0 0\n", "line 2"),
        (LINE + "2.5 1 2 x 0 0 0 1\n", "line 2"),
        (LINE + "2.5 1 2 nan 0 0 0 1\n", "line 2"),
        (LINE + "nan 1 2 3 0 0 0 1\n", "line 2"),
        (LINE + "inf 1 2 3 0 0 0 1\n", "line 2"),
        (LINE + "1e300 1 2 3 0 0 0 1\n", "line 2"),
        (LINE + "9" * 30 + " 1 2 3 0 0 0 1\n", "line 2"),
        (LINE + "2.5 1 2 3 0 0 0 0\n", "zero"),
        (LINE + "2.5 1 2 3 1e200 0 0 1e200\n", "too large"),
        ("# only a comment\n", "no poses"),
        ("", "no poses"),
    ],
)
def test_wrong_text_is_refused_in_one_line(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "t.txt"
    path.write_text(text)
    with pytest.raises(GeometryError, match=says) as error:
        read_tum(path)
    assert "\n" not in str(error.value) and "t.txt" in str(error.value)


def test_bytes_that_are_no_text_and_missing_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "b.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(GeometryError, match="not a text file"):
        read_tum(tmp_path / "b.txt")
    with pytest.raises(GeometryError, match="No such file"):
        read_tum(tmp_path / "nowhere.txt")
    with pytest.raises(GeometryError, match="directory"):
        read_tum(tmp_path)


def test_lines_are_sorted_by_time_and_quaternions_normalised(tmp_path: Path) -> None:
    path = tmp_path / "t.txt"
    path.write_text("2 1 0 0 0 0 0 2\n1,0,0,0,0,0,3,0 # commas and comments are fine\n")
    read = read_tum(path)
    assert read.time_ns.tolist() == [1_000_000_000, 2_000_000_000]
    np.testing.assert_allclose(np.linalg.norm(read.quaternion_xyzw, axis=1), 1)


def test_poses_between_poses_follow_the_motion() -> None:
    trajectory = random_trajectory(5)
    for i in range(5):
        np.testing.assert_allclose(
            trajectory.at(int(trajectory.time_ns[i])), trajectory.wTc[i], atol=1e-6
        )
    t0, t1 = trajectory.time_ns[1:3].tolist()
    half = trajectory.at((t0 + t1) // 2)
    expected = poses.interpolate(trajectory.wTc[1], trajectory.wTc[2], 0.5)
    np.testing.assert_allclose(half, expected, atol=1e-5)


def test_past_the_ends_a_trajectory_is_constant() -> None:
    trajectory = random_trajectory(5)
    np.testing.assert_allclose(trajectory.at(0), trajectory.wTc[0])
    np.testing.assert_allclose(trajectory.at(2**62), trajectory.wTc[-1])


def test_the_nearest_pose_in_time_is_found_and_an_empty_trajectory_has_none() -> None:
    trajectory = random_trajectory(5)
    assert trajectory.nearest(int(trajectory.time_ns[3]) + 1) == 3
    empty = Trajectory.from_poses([], np.empty((0, 4, 4)))
    for ask in (empty.nearest, empty.at):
        with pytest.raises(GeometryError):
            ask(0)


def test_lengths_that_differ_are_refused() -> None:
    with pytest.raises(GeometryError):
        Trajectory(np.zeros(2, np.int64), np.zeros((3, 3)), np.zeros((2, 4)))
