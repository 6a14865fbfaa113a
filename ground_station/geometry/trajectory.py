"""Trajectories: poses with times, and TUM text files of them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import starmap
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ground_station.arrays import F64, I64
from ground_station.errors import GeometryError
from ground_station.files import write_text
from ground_station.geometry import poses
from pi_firmware.wire.errors import os_errors_as


@dataclass(frozen=True)
class Trajectory:
    """`wTc` at N times: `time_ns` (N,) int64, `position_m` (N, 3), `quaternion_xyzw` (N, 4)."""

    time_ns: I64
    position_m: F64
    quaternion_xyzw: F64

    def __post_init__(self) -> None:
        n = len(self.time_ns)
        if self.position_m.shape != (n, 3) or self.quaternion_xyzw.shape != (n, 4):
            raise GeometryError("trajectory: times, positions and quaternions differ in number")

    def __len__(self) -> int:
        return len(self.time_ns)

    def __getitem__(self, chosen: slice | npt.NDArray[Any]) -> Trajectory:
        """The poses of some indices, or of those that an array of N booleans marks."""
        return Trajectory(
            self.time_ns[chosen], self.position_m[chosen], self.quaternion_xyzw[chosen]
        )

    @classmethod
    def from_poses(cls, time_ns: npt.ArrayLike, wTc: npt.ArrayLike) -> Trajectory:
        """From times (N,), nanoseconds, and poses (N, 4, 4)."""
        T = np.asarray(wTc, dtype=np.float64).reshape(-1, 4, 4)
        quaternions = poses.to_quaternion(T) if len(T) else np.empty((0, 4))
        return cls(np.asarray(time_ns, dtype=np.int64), T[:, :3, 3].copy(), quaternions)

    @property
    def wTc(self) -> F64:
        """All poses, (N, 4, 4)."""
        return poses.from_quaternion(self.position_m, self.quaternion_xyzw)

    def nearest(self, time_ns: int) -> int:
        """The index of the pose nearest in time; raises `GeometryError` when there is none."""
        if not len(self):
            raise GeometryError("trajectory: it has no poses")
        return int(np.argmin(np.abs(self.time_ns - time_ns)))

    def at(self, time_ns: int) -> F64:
        """The pose at a time between two others by constant twist; held constant past the ends."""
        if not len(self):
            raise GeometryError("trajectory: it has no poses")
        right = int(np.searchsorted(self.time_ns, time_ns))
        if right == 0 or right == len(self):
            i = min(right, len(self) - 1)
            return poses.from_quaternion(self.position_m[i], self.quaternion_xyzw[i])
        pair = poses.from_quaternion(
            self.position_m[right - 1 : right + 1], self.quaternion_xyzw[right - 1 : right + 1]
        )
        t0, t1 = int(self.time_ns[right - 1]), int(self.time_ns[right])
        return poses.interpolate(pair[0], pair[1], (time_ns - t0) / (t1 - t0))


def seconds_to_ns(text: str) -> int:
    """Decimal seconds as text to whole nanoseconds, without passing through a binary fraction.

    Raises ValueError when the text is not a plain or exponential decimal number.
    """
    sign = -1 if text.startswith("-") else 1
    digits = text.lstrip("+-")
    if "e" in digits.lower() or not digits.replace(".", "", 1).isdigit():
        return round(float(text) * 1e9)
    whole, _, fraction = digits.partition(".")
    return sign * (int(whole or 0) * 1_000_000_000 + int((fraction + "0" * 9)[:9]))


_LINE = "time_s x y z qx qy qz qw"


def read_tum(path: str | Path) -> Trajectory:
    """Reads `timestamp tx ty tz qx qy qz qw` lines (seconds, metres), sorted by time.

    Quaternions are normalised. Raises `GeometryError` naming the line that is not eight finite
    numbers or has a zero quaternion. Two poses of one time are kept in the order of the file, as
    evo does: motion-capture files have them.
    """
    path = Path(path)
    try:
        with os_errors_as(path, GeometryError):
            text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise GeometryError(f"{path}: not a text file; wanted: lines of {_LINE}") from None
    rows: list[tuple[int, list[float]]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            time_ns, values = seconds_to_ns(words[0]), [float(word) for word in words[1:]]
        except (ValueError, OverflowError):
            raise GeometryError(
                f"{path}, line {number}: not a number in {line!r:.80}; wanted: {_LINE}"
            ) from None
        if not -(2**63) <= time_ns < 2**63:
            raise GeometryError(f"{path}, line {number}: the time {words[0]:.40} s is out of range")
        if len(values) != 7 or not np.all(np.isfinite(values)):
            raise GeometryError(f"{path}, line {number}: eight finite numbers are needed: {_LINE}")
        if not 1e-6 <= math.hypot(*values[3:]) <= 1e100:  # beyond, its square is infinite
            raise GeometryError(f"{path}, line {number}: the quaternion is zero or too large")
        rows.append((time_ns, values))
    if not rows:
        raise GeometryError(f"{path}: it holds no poses; wanted: lines of {_LINE}")
    rows.sort(key=lambda row: row[0])
    times = np.array([row[0] for row in rows], dtype=np.int64)
    table = np.array([row[1] for row in rows])
    quaternions = table[:, 3:] / np.linalg.norm(table[:, 3:], axis=1, keepdims=True)
    return Trajectory(times, table[:, :3].copy(), quaternions)


def tum_line(time_ns: int, position_m: Iterable[float], quaternion_xyzw: Iterable[float]) -> str:
    """One pose as TUM text, without its line's end."""
    sign, (s, ns) = ("-" if time_ns < 0 else ""), divmod(abs(time_ns), 1_000_000_000)
    numbers = " ".join(f"{value:.9f}" for value in (*position_m, *quaternion_xyzw))
    return f"{sign}{s}.{ns:09d} {numbers}"


def write_tum(path: str | Path, trajectory: Trajectory, comments: Sequence[str] = ()) -> None:
    """Writes a TUM text file, beside and renamed, with `comments` as its first lines."""
    poses = zip(
        trajectory.time_ns.tolist(),
        trajectory.position_m,
        trajectory.quaternion_xyzw,
        strict=True,
    )
    lines = [*comments, "# timestamp tx ty tz qx qy qz qw", *starmap(tum_line, poses)]
    write_text(path, "\n".join(lines) + "\n")
