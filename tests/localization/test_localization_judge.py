"""The state machine: down at once, up again only after good frames, and why."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ground_station.localization.estimate import State
from ground_station.localization.judge import Evidence, Judge
from ground_station.localization.settings import load_preset

STEP_NS = 33_333_333
GOOD = Evidence(
    inliers=200,
    observations=220,
    spread=0.2,
    residual_px=1.5,
    covariance=np.diag([1e-6] * 3 + [1e-4] * 3),
    innovation=5.0,
    support_ns=0,
)


@pytest.fixture
def judge() -> Judge:
    return Judge(load_preset("default").state)


def frame(judge: Judge, k: int, **changes):
    seen = dataclasses.replace(GOOD, **({"support_ns": k * STEP_NS} | changes))
    return judge.solved(k * STEP_NS, seen)


def test_a_good_frame_is_tracking_and_gives_no_reason(judge):
    assert judge.state is State.INITIALIZING
    assert frame(judge, 0) == (State.TRACKING, "")


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"inliers": 12}, "few inliers: 12"),
        ({"observations": 500}, "few agree: 200 of 500"),
        ({"spread": 0.01}, "poor spread: 0.010"),
        ({"residual_px": 9.0}, "high residual: 9.0 px"),
        ({"covariance": np.diag([1e-6] * 3 + [0.006] * 3)}, "uncertain position: 0.13 m"),
        ({"covariance": np.diag([3e-4] * 3 + [1e-4] * 3)}, "uncertain direction: 1.7 deg"),
        ({"covariance": np.full((6, 6), np.nan)}, "uncertain position: nan m"),
        ({"innovation": 400.0}, "jump: 20.0 sigma from the prediction"),
        (
            {"support_ns": -2_000_000_000, "denied": 3},
            "stale keyframe: 2.0 s old, not confirmed by 3 since",
        ),
        ({"sharpness": 0.2}, "blur: 0.20 of the usual sharpness"),
    ],
)
def test_each_fault_degrades_at_once_and_is_named(judge, changes, why):
    frame(judge, 0)
    state, reason = frame(judge, 1, **({"support_ns": STEP_NS} | changes))
    assert (state, reason.replace("2.03", "2.0")) == (State.DEGRADED, why)


def test_an_old_keyframe_that_nobody_had_the_time_to_look_at_again_refuses_no_pose(judge):
    """Under overload: what the frame itself shows is as good as ever."""
    frame(judge, 0)
    assert frame(judge, 1, support_ns=-5_000_000_000) == (State.TRACKING, "")
    assert frame(judge, 2, support_ns=STEP_NS, denied=1) == (State.TRACKING, "")


def test_tracking_comes_back_only_after_several_good_frames(judge):
    frame(judge, 0)
    frame(judge, 1, inliers=12)
    first, second = frame(judge, 2), frame(judge, 3)
    assert first[0] is State.DEGRADED and first[1].startswith("just recovered; 1 of 2")
    assert second == (State.TRACKING, "")


def test_a_bad_frame_among_the_good_ones_starts_the_count_again(judge):
    frame(judge, 0)
    frame(judge, 1, inliers=12)
    assert frame(judge, 2)[0] is State.DEGRADED
    frame(judge, 3, inliers=12)
    assert frame(judge, 4)[0] is State.DEGRADED
    assert frame(judge, 5)[0] is State.TRACKING


def test_what_was_found_again_needs_features_of_later_frames(judge):
    frame(judge, 0)
    judge.found_again(10 * STEP_NS, judge.settings.sure_significance - 1)
    assert judge.doubtful
    for k in range(11, 20):  # its own points, followed for as long as they like
        state, reason = frame(judge, k, support_ns=10 * STEP_NS)
        assert state is State.DEGRADED and "to be confirmed; 0 of 2" in reason
    assert frame(judge, 20, support_ns=15 * STEP_NS)[0] is State.DEGRADED
    assert frame(judge, 21, support_ns=15 * STEP_NS)[0] is State.TRACKING
    assert not judge.doubtful


def test_what_was_found_beyond_doubt_needs_no_other_frame(judge):
    frame(judge, 0)
    judge.unsolved(100 * STEP_NS)
    judge.found_again(101 * STEP_NS, judge.settings.sure_significance)
    assert not judge.doubtful
    assert frame(judge, 101, support_ns=101 * STEP_NS)[0] is State.TRACKING


def test_unsolved_frames_are_degraded_and_then_lost_until_one_is_solved(judge):
    frame(judge, 0)
    states = [judge.unsolved(k * STEP_NS) for k in range(1, 30)]
    lost_from = states.index(State.LOST)
    assert (lost_from + 1) * STEP_NS == pytest.approx(0.3e9, abs=STEP_NS)
    assert set(states[lost_from:]) == {State.LOST}
    # One that is solved again is not TRACKING at once, and unsolved ones before a first stay so.
    assert frame(judge, 30)[0] is State.DEGRADED
    assert Judge(judge.settings).unsolved(0) is State.INITIALIZING


def test_a_skipped_frame_may_be_given_more_patience(judge):
    frame(judge, 0)
    assert judge.unsolved(15 * STEP_NS, patience_s=1.0) is State.DEGRADED
    assert judge.unsolved(16 * STEP_NS) is State.LOST
    # Once lost, patience does not undo it.
    assert judge.unsolved(17 * STEP_NS, patience_s=10.0) is State.LOST


def test_the_thesis_preset_is_tracking_again_with_the_next_solved_frame():
    judge = Judge(load_preset("thesis").state)
    frame(judge, 0)
    frame(judge, 1, inliers=12)
    assert frame(judge, 2, residual_px=50.0, innovation=1e6)[0] is State.TRACKING
