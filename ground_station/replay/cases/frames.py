"""What became of each frame of a run, as a table: a CSV file that keeps every bit of the poses.

Two such tables are the same, bit for bit, or it is told where they first part.
"""

from __future__ import annotations

import csv
import hashlib
import io
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ground_station.arrays import F64, I64, Bools, Indices
from ground_station.errors import InputError
from ground_station.files import read_bytes, write_text
from ground_station.geometry import poses
from ground_station.geometry.trajectory import Trajectory
from ground_station.localization.estimate import State
from ground_station.replay.live import LiveFrame
from pi_firmware.wire.text import printable

UNKNOWN = -1
"""A time that is not known, as of a capture by a clock that never answered."""
_TIMES = ("sequence", "time_ns", "captured_ns", "arrival_ns", "done_ns")
_POSE = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
COLUMNS = (*_TIMES, "state", "reason", "relocalized", *_POSE, "pose_sha256")
_MOST_BYTES = 256 << 20
_FARTHEST_M = 1e7
_STATES = tuple(state.value for state in State)
_Row = tuple[list[int], tuple[str, str, bool, str], list[float]]
"""Times, state with its reason, whether relocalized and the digest, and the pose."""


@dataclass(frozen=True)
class Frames:
    """N frames that reached the localizer, in the order in which they did.

    Each is (N,): `sequence` the payload's number; `time_ns` the camera's capture time; by the
    ground's clock `captured_ns` (`UNKNOWN` where the payload's clock never answered), `arrival_ns`
    and `done_ns`, when the pose was there. `position_m` (N, 3) and `quaternion_xyzw` (N, 4) are
    wTc, NaN without a pose; `digest` is "" there, else of the 16 numbers of wTc as they are in
    memory: equal digests, equal bits.
    """

    sequence: I64
    time_ns: I64
    captured_ns: I64
    arrival_ns: I64
    done_ns: I64
    state: tuple[str, ...]
    reason: tuple[str, ...]
    relocalized: Bools
    position_m: F64
    quaternion_xyzw: F64
    digest: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.sequence)

    @property
    def localized(self) -> Bools:
        """(N,), which have a pose, finite or not."""
        return np.array([digest != "" for digest in self.digest], dtype=bool)

    @property
    def finite(self) -> Bools:
        """(N,), which have a pose that can be one: finite, on this Earth, of a unit quaternion."""
        with np.errstate(over="ignore", invalid="ignore"):  # a comparison with NaN is False
            near = (np.abs(self.position_m) <= _FARTHEST_M).all(axis=1)
            unit = np.abs(np.linalg.norm(self.quaternion_xyzw, axis=1) - 1.0) <= 1e-3
        return np.asarray(self.localized & near & unit)

    @property
    def broken(self) -> int:
        """How many have a pose that can be none."""
        return int((self.localized & ~self.finite).sum())

    def called(self, state: str) -> Bools:
        """(N,), which have this state."""
        return np.array([name == state for name in self.state], dtype=bool)

    @property
    def latency_ms(self) -> F64:
        """(N,), capture to pose; NaN where the time of capture is not known."""
        took = (self.done_ns - self.captured_ns) / 1e6
        return np.where(self.captured_ns == UNKNOWN, np.nan, took)

    def ordered(self) -> Indices:
        """The indices of the finite poses by capture time."""
        found = np.flatnonzero(self.finite)
        return found[np.argsort(self.time_ns[found], kind="stable")]

    def trajectory(self) -> Trajectory:
        """The finite poses by capture time, whatever their state."""
        k = self.ordered()
        return Trajectory(self.time_ns[k], self.position_m[k], self.quaternion_xyzw[k])


def table(rows: Sequence[LiveFrame], captured_ns: Sequence[int]) -> Frames:
    """The table of some frames, and when each was captured by the ground's clock."""
    found = []
    for row, captured in zip(rows, captured_ns, strict=True):
        e, pose, code = row.estimate, [math.nan] * len(_POSE), ""
        if e.wTc is not None:
            pose[:3], code = e.wTc[:3, 3], digest(e.wTc)
            if np.isfinite(e.wTc).all():
                pose[3:] = poses.to_quaternion(e.wTc)
        times = [row.sequence, e.time_ns, captured, row.arrival_ns, row.done_ns]
        found.append((times, (e.state.value, e.reason, e.relocalized, code), pose))
    return _of_rows(found)


def digest(wTc: npt.ArrayLike) -> str:
    """Of a pose's numbers, bit for bit: 32 hexadecimal digits of their SHA-256."""
    return hashlib.sha256(np.ascontiguousarray(wTc, dtype="<f8").tobytes()).hexdigest()[:32]


def write_csv(path: str | Path, frames: Frames) -> None:
    """Writes the table; numbers in the shortest form that reads back as the same double."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(COLUMNS)
    times = np.column_stack([getattr(frames, name) for name in _TIMES]).tolist()
    numbers = np.hstack([frames.position_m, frames.quaternion_xyzw]).tolist()
    for k in range(len(frames)):
        pose = numbers[k] if frames.digest[k] else [""] * len(_POSE)
        told = (frames.state[k], printable(frames.reason[k], 200, " "), int(frames.relocalized[k]))
        writer.writerow([*times[k], *told, *pose, frames.digest[k]])
    write_text(path, out.getvalue())


def read_csv(path: str | Path) -> Frames:
    """Reads what `write_csv` wrote; raises `InputError` with one line that names the line."""
    path = Path(path)
    try:
        text = read_bytes(path, _MOST_BYTES).decode()
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file") from None
    if text and not text.endswith("\n"):
        raise InputError(f"{path}: cut in the middle of its last line")
    try:
        head, *rows = csv.reader(io.StringIO(text), strict=True) if text else [[]]
    except csv.Error as error:
        raise InputError(f"{path}: not CSV: {error}") from None
    if head != list(COLUMNS):
        raise InputError(f"{path}, line 1: not the columns {','.join(COLUMNS)}")
    parsed = []
    for number, row in enumerate(rows, start=2):
        try:
            parsed.append(_parsed(row))
        except (ValueError, OverflowError) as error:
            raise InputError(f"{path}, line {number}: {str(error)[:100]!s}") from None
    return _of_rows(parsed)


def _of_rows(rows: Sequence[_Row]) -> Frames:
    times, told, pose = zip(*rows, strict=True) if rows else ((), (), ())
    columns: Any = np.array(times, np.int64).reshape(-1, len(_TIMES)).T.copy()
    numbers = np.array(pose, np.float64).reshape(-1, len(_POSE))
    state, reason, relocalized, code = zip(*told, strict=True) if rows else ((), (), (), ())
    return Frames(
        **dict(zip(_TIMES, columns, strict=True)),
        state=state,
        reason=reason,
        relocalized=np.array(relocalized, dtype=bool),
        position_m=numbers[:, :3].copy(),
        quaternion_xyzw=numbers[:, 3:].copy(),
        digest=code,
    )


def _parsed(row: list[str]) -> _Row:
    if len(row) != len(COLUMNS):
        raise ValueError(f"{len(row)} columns; {len(COLUMNS)} are needed")
    n = len(_TIMES)
    times = [int(text) for text in row[:n]]
    if not all(UNKNOWN <= value < 1 << 63 for value in times):
        raise ValueError("a time or number is not between 0 and 2^63")
    state, reason, relocalized = row[n : n + 3]
    if state not in _STATES:
        raise ValueError(f"the state is {state[:40]!r}; allowed: {', '.join(_STATES)}")
    if relocalized not in ("0", "1"):
        raise ValueError(f"relocalized is {relocalized[:40]!r}; allowed: 0, 1")
    pose, code = row[n + 3 : -1], row[-1]
    if not code:
        if any(pose):
            raise ValueError("a pose without its digest")
        return times, (state, reason, relocalized == "1", ""), [math.nan] * len(_POSE)
    if len(code) != 32 or not set(code) <= set("0123456789abcdef"):
        raise ValueError(f"pose_sha256 is {code[:40]!r}; allowed: 32 hexadecimal digits")
    return times, (state, reason, relocalized == "1", code), [float(text) for text in pose]


@dataclass(frozen=True)
class Pairs:
    """The frames of two runs by capture time: `a` and `b` (M,) are indices of those in both, in
    order of time; `only_a` and `only_b` of the others.
    """

    a: Indices
    b: Indices
    only_a: Indices
    only_b: Indices


@dataclass(frozen=True)
class Difference:
    """How many frames differ in pose, state or presence; the first of them, `told` in words."""

    count: int
    time_ns: int | None = None
    told: str = ""


def pairs(a: Frames, b: Frames) -> Pairs:
    """Pairs of exactly the same capture time; of several at one time the n-th with the n-th."""
    index_a, index_b = _indices(a), _indices(b)
    both = sorted(index_a.keys() & index_b.keys())

    def array(indices: Iterable[int]) -> Indices:
        return np.fromiter(indices, np.intp)

    return Pairs(
        array(index_a[key] for key in both),
        array(index_b[key] for key in both),
        array(k for key, k in index_a.items() if key not in index_b),
        array(k for key, k in index_b.items() if key not in index_a),
    )


def _indices(frames: Frames) -> dict[tuple[int, int], int]:
    """By capture time, and number among those of the same."""
    seen: Counter[int] = Counter()
    found = {}
    for k, time_ns in enumerate(frames.time_ns.tolist()):
        found[time_ns, seen[time_ns]] = k
        seen[time_ns] += 1
    return found


def differing(a: Frames, b: Frames, both: Pairs) -> Bools:
    """(M,), which pairs differ in a bit of the pose, or in the state."""
    return np.array(
        [
            a.digest[i] != b.digest[j] or a.state[i] != b.state[j]
            for i, j in zip(both.a.tolist(), both.b.tolist(), strict=True)
        ],
        dtype=bool,
    )


def first_difference(a: Frames, b: Frames) -> Difference:
    """Of two runs; count 0 when all poses and states are the same, bit for bit."""
    both = pairs(a, b)
    unlike = differing(a, b, both)
    count = int(unlike.sum()) + len(both.only_a) + len(both.only_b)
    if not count:
        return Difference(0)
    found: list[tuple[int, str]] = []
    for name, frames, only in (("first", a, both.only_a), ("second", b, both.only_b)):
        if len(only):
            k = only[np.argmin(frames.time_ns[only])]
            time_ns = int(frames.time_ns[k])
            found.append((time_ns, f"frame {int(frames.sequence[k])} is in the {name} run only"))
    if unlike.any():
        k = int(np.argmax(unlike))
        i, j = int(both.a[k]), int(both.b[k])
        found.append((int(a.time_ns[i]), _parted(a, b, i, j)))
    time_ns, told = min(found)
    return Difference(count, time_ns, f"at {time_ns / 1e9:.3f} s {told}")


def _parted(a: Frames, b: Frames, i: int, j: int) -> str:
    name = f"frame {int(a.sequence[i])}"
    if a.state[i] != b.state[j]:
        return f"{name} is {a.state[i]} and then {b.state[j]}"
    if not a.digest[i] or not b.digest[j]:
        return f"{name} has a pose in the {'second' if b.digest[j] else 'first'} run only"
    apart_m = float(np.linalg.norm(a.position_m[i] - b.position_m[j]))
    return f"{name} is {apart_m:.3g} m off"
