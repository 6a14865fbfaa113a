"""Frames that structure from motion put where a camera cannot have been."""

from __future__ import annotations

import numpy as np

from ground_station.arrays import F64, I64, Bools

_SLACK_DEPTHS = 0.05
"""A step that is always plausible, in depths of the scene: a hovering camera has no usual speed."""
_GAP_STEPS = 20.0
"""A pause so many usual steps long says nothing about where the camera went meanwhile."""


def plausible_frames(time_ns: I64, position: F64, depth: float, max_jump: float) -> Bools:
    """Which frames belong to the largest set in which every step is plausible, (K,).

    `time_ns` (K,) in the order of the input, `position` (K, 3) and `depth`, the median distance of
    what the frames see, in the same units. A step between frames is plausible when it is at most
    `max_jump` times as fast as nine in ten of all steps. Where time falls back or pauses
    for long (another input), a new sequence starts, which is judged by itself.
    """
    keep = np.ones(len(time_ns), dtype=bool)
    dt = np.diff(time_ns) / 1e9
    if not (dt > 0).any():
        return keep
    usual_s = float(np.median(dt[dt > 0]))
    breaks = np.flatnonzero((dt <= 0) | (dt > _GAP_STEPS * usual_s)) + 1
    steps = np.linalg.norm(np.diff(position, axis=0), axis=1)
    inside = (dt > 0) & (dt <= _GAP_STEPS * usual_s)
    if not inside.any():
        return keep
    speed = max_jump * float(np.percentile(steps[inside] / dt[inside], 90))
    for part in np.split(np.arange(len(time_ns)), breaks):
        keep[part] = _longest_chain(
            time_ns[part] / 1e9, position[part], speed, _SLACK_DEPTHS * depth
        )
    return keep


def _longest_chain(time_s: F64, position: F64, speed: float, slack: float) -> Bools:
    """The most frames, in order, with every step at most speed · Δt + slack; by dynamic program."""
    n = len(time_s)
    length, before = np.ones(n, dtype=int), np.full(n, -1)
    for i in range(1, n):
        reach = speed * (time_s[i] - time_s[:i]) + slack
        possible = np.linalg.norm(position[:i] - position[i], axis=1) <= reach
        if possible.any():
            # Of equally long chains the one with the nearest predecessor.
            j = i - 1 - int(np.argmax(np.where(possible, length[:i], 0)[::-1]))
            length[i], before[i] = length[j] + 1, j
    keep = np.zeros(n, dtype=bool)
    i = int(np.argmax(length))
    while i >= 0:
        keep[i] = True
        i = int(before[i])
    return keep
