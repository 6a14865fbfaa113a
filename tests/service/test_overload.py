"""Overload: what counts as one, what it says, and that it ends."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from ground_station.service.localizing.process import WINDOW_S, Overload


@pytest.fixture
def localizer() -> SimpleNamespace:
    return SimpleNamespace(keyframe_late_s=0.2, overloaded=False)


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
    assert set(said) == {""} and not localizer.overloaded


def test_skipped_frames_are_said_and_keyframes_become_rare(localizer):
    said = fly(Overload(), localizer, 2)
    assert (
        said[-1] == "this computer is too slow: 30 of 60 frames skipped in 2 s; keyframes are rare"
    )
    assert localizer.overloaded


def test_it_ends_with_its_cause_and_with_a_new_count(localizer):
    overload = Overload()
    fly(overload, localizer, 3)
    taken, skipped = 100, 200
    said = [
        overload.watch(localizer, 10 + k / 30, taken + k, skipped)
        for k in range(round((WINDOW_S + 0.2) * 30))
    ]
    assert said[0] and not said[-1] and not localizer.overloaded
    assert overload.watch(localizer, 13.0, 1, 0) == ""


def test_late_features_alone_are_said_and_shed_nothing(localizer):
    localizer.keyframe_late_s = 1.4
    said = fly(Overload(), localizer, 1, 60)
    assert said[-1] == "this computer is too slow: features under way for 1.4 s; keyframes are late"
    assert not localizer.overloaded
