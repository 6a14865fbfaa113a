"""Whether two runs gave the same poses, bit for bit, and where they first part."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from ground_station.arrays import Bools, Indices
from ground_station.replay.cases.frames import Frames


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
    index_b = {key: k for k, key in enumerate(_keys(b))}
    found: list[tuple[int, int]] = []
    only_a: list[int] = []
    for k, key in enumerate(_keys(a)):
        other = index_b.pop(key, None)
        if other is None:
            only_a.append(k)
        else:
            found.append((k, other))
    found.sort(key=lambda pair: (int(a.time_ns[pair[0]]), pair))
    both = np.array(found, dtype=np.intp).reshape(-1, 2)
    return Pairs(
        both[:, 0],
        both[:, 1],
        np.array(only_a, dtype=np.intp),
        np.array(sorted(index_b.values()), dtype=np.intp),
    )


def _keys(frames: Frames) -> list[tuple[int, int]]:
    seen: Counter[int] = Counter()
    keys = []
    for time_ns in frames.time_ns.tolist():
        keys.append((time_ns, seen[time_ns]))
        seen[time_ns] += 1
    return keys


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
