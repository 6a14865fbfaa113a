"""Overload: what counts as one, what it says, and that it ends."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from ground_station.service.localizing.process import FIRST_REST_S, RARE_S, WAITING_S, Overload


@pytest.fixture
def localizer() -> SimpleNamespace:
    return SimpleNamespace(keyframe_late_s=0.2, rest_s=0.0)


def fly(overload: Overload, localizer, every: int, frames: int = 300, start: int = 0) -> list[str]:
    """30 Hz of which each `every`-th frame is taken; 1: all."""
    said = []
    for k in range(start, start + frames):
        if k % every == 0:
            taken = k // every + 1
            said.append(overload.watch(localizer, k / 30, taken, k + 1 - taken))
    return said


def test_a_frame_missed_now_and_then_is_none(localizer):
    said = [
        Overload().watch(localizer, 0.0, 1, 0),
        *fly(overload := Overload(), localizer, 1, 100),
        overload.watch(localizer, 3.4, 101, 2),
    ]
    assert set(said) == {""} and localizer.rest_s == 0.0


def test_skipped_frames_are_said_and_keyframes_become_rare(localizer):
    said = fly(Overload(), localizer, 2)
    assert (
        said[-1] == "this computer is too slow: 30 of 60 frames skipped in 2 s; keyframes are rare"
    )
    assert localizer.rest_s > RARE_S


def test_it_ends_with_its_cause_and_with_a_new_count(localizer):
    overload = Overload()
    fly(overload, localizer, 3)
    taken, skipped = 100, 200
    said = [overload.watch(localizer, 10 + k / 30, taken + k, skipped) for k in range(30 * 30)]
    assert said[0] and not said[-1] and localizer.rest_s < FIRST_REST_S
    assert overload.watch(localizer, 41.0, 1, 0) == ""


def test_keyframes_that_rest_are_said_while_frames_are_skipped_now_and_then(localizer):
    overload, said = Overload(), []
    for k in range(15 * 30):
        skipped = 4 * sum(k >= at for at in (30, 60, 120, 240))
        said.append(overload.watch(localizer, k / 30, 40 + k - skipped, skipped))
    assert said[190] == "this computer is too slow: a keyframe in 1.4 s is what it bears"
    assert said[29] == said[-1] == "" and localizer.rest_s > RARE_S


def test_frames_that_are_late_again_make_keyframes_rare_before_any_is_skipped(localizer):
    overload, rests = Overload(), []
    for k in range(20 * 30):
        late = k in (*range(90, 96), *range(150, 156))
        overload.watch(localizer, k / 30, k + 1, 0, WAITING_S if late else 0.0)
        rests.append(localizer.rest_s)
    assert rests[149] == 0.0 and rests[150] == FIRST_REST_S == max(rests)
    assert 0 < rests[-1] < 0.5


def test_frames_that_stay_late_make_keyframes_rarer_still(localizer):
    overload = Overload()
    for k in range(90):
        overload.watch(localizer, k / 30, k + 1, 0, 0.2)
    assert localizer.rest_s > 2 * FIRST_REST_S


def test_late_features_alone_are_said_and_shed_nothing(localizer):
    localizer.keyframe_late_s = 1.4
    said = fly(Overload(), localizer, 1, 60)
    assert said[-1] == "this computer is too slow: features under way for 1.4 s; keyframes are late"
    assert not localizer.rest_s


@pytest.mark.parametrize("cores", [0.6, 0.7, 0.8, 1.0])
def test_keyframes_take_what_the_frames_leave(localizer, cores):
    """A processor of which 30 frames a second take half, and a keyframe as much as six frames."""
    overload, taken, skipped, behind_s, keyframe_s, keyframes = Overload(), 0, 0, 0.0, 0.0, 0
    late = 0
    for k in range(60 * 30):
        now_s = k / 30
        behind_s = max(0.0, behind_s - cores / 30)
        if behind_s > 8 / 30:
            skipped += 1
            late += now_s > 10
            continue
        taken += 1
        behind_s += 0.5 / 30
        if now_s - keyframe_s >= max(0.3, localizer.rest_s):
            behind_s, keyframe_s, keyframes = behind_s + 0.1, now_s, keyframes + 1
        overload.watch(localizer, now_s, taken, skipped, behind_s)
    assert late <= 0.02 * 50 * 30
    assert keyframes >= 0.5 * min(60 / 0.3, 60 * (cores - 0.5) / 0.1)
