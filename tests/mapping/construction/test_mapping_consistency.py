"""Frames where a camera cannot have been are dropped, and no others."""

from __future__ import annotations

import numpy as np

from ground_station.mapping.construction.solver import plausible_frames

STEP_NS = 800_000_000


def _walk(n: int, seed: int = 0):
    rng = np.random.default_rng(seed)
    step = rng.uniform(0.2, 0.6, (n, 1)) * [1.0, 0.3, 0.0] + 0.05 * rng.normal(size=(n, 3))
    return np.arange(n) * STEP_NS, np.cumsum(step, axis=0)


def _keep(time_ns, position):
    return plausible_frames(time_ns, position, depth=6.0, max_jump=4.0)


def test_a_smooth_path_keeps_every_frame():
    assert _keep(*_walk(80)).all()


def test_single_frames_and_groups_metres_off_are_dropped():
    time_ns, position = _walk(80)
    wrong = np.zeros(80, bool)
    wrong[[0, 20, 40, 41, 42, 79]] = True
    position[wrong] += [0.0, 9.0, 4.0]
    assert np.array_equal(~_keep(time_ns, position), wrong)


def test_a_camera_that_hovers_and_then_moves_on_is_kept():
    time_ns, position = _walk(80)
    position[10:70] = position[10] + 0.002 * np.random.default_rng(1).normal(size=(60, 3))
    position[70:] += position[10] - position[70]
    assert _keep(time_ns, position).all()


def test_missing_frames_leave_time_for_a_longer_way():
    time_ns, position = _walk(80)
    some = np.r_[0:20, 30:80]
    assert _keep(time_ns[some], position[some]).all()


def test_another_input_may_start_anywhere():
    time_ns, position = _walk(40)
    both = np.concatenate([position, position + 30.0])
    assert _keep(np.concatenate([time_ns, time_ns]), both).all()
    assert _keep(np.concatenate([time_ns, time_ns + 10**12]), both).all()
