"""A stream may last: what a localizer holds does not grow with the frames it has seen."""

from __future__ import annotations

import gc
import sys
from types import FunctionType, ModuleType

import numpy as np
import pytest
from synthetic import FakeExtractor

from ground_station.features.extractor import Features
from ground_station.localization.estimate import State
from ground_station.localization.localizer import Localizer
from ground_station.localization.settings import load_preset

FRAME_NS = 33_333_333
ROUND = 45
"""Frames of a round: longer than the smoother's lag, and than any of the windows."""


class Standing(FakeExtractor):
    """A camera at rest before a patterned wall, whose lens is covered now and then."""

    def __init__(self, room, wTc: np.ndarray) -> None:
        self.seen = room.features(wTc)
        pattern = np.random.default_rng(3).integers(0, 255, (120, 160), np.uint8)
        self.image = np.kron(pattern, np.ones((4, 4), np.uint8))
        self.covered = np.zeros_like(self.image)

    def extract(self, image: np.ndarray) -> Features:
        return self.seen if image.any() else self.seen.where(np.zeros(len(self.seen), bool))


def held(root: object) -> int:
    """The bytes of everything that can be reached from an object."""
    known, open_, total = {id(root)}, [root], 0
    while open_:
        one = open_.pop()
        total += sys.getsizeof(one)
        for other in gc.get_referents(one):
            if id(other) not in known and not isinstance(other, type | ModuleType | FunctionType):
                known.add(id(other))
                open_.append(other)
    return total


def fly(localizer: Localizer, camera: Standing, frames: range) -> list[State]:
    states = []
    for k in frames:
        covered = k % ROUND >= ROUND - 12  # for longer than it takes to be lost
        image = camera.covered if covered else camera.image
        states.append(localizer.process(k * FRAME_NS, image.copy(), k).state)
    return states


@pytest.fixture
def camera(room) -> Standing:
    return Standing(room, room.path(1)[1][0])


def test_what_a_localizer_holds_does_not_grow_with_its_stream(room, camera):
    localizer = Localizer(room.map, room.camera, camera, load_preset("default"))
    states = fly(localizer, camera, range(ROUND))
    assert {State.TRACKING, State.LOST} <= set(states)
    rounds = []
    for k in range(1, 6):
        fly(localizer, camera, range(k * ROUND, (k + 1) * ROUND))
        rounds.append(held(localizer))
    # Two rounds, as a round's last search lands in the next; grown by less than a number a frame.
    assert max(rounds[3:]) < max(rounds[:2]) + 3 * ROUND * 8
    assert localizer.smoothed() == localizer.finish() == []


def test_who_asks_for_smoothed_poses_gets_each_once(room, camera):
    localizer = Localizer(room.map, room.camera, camera, load_preset("default"), smoothing=True)
    fly(localizer, camera, range(ROUND - 12))
    smoothed = [*localizer.smoothed(), *localizer.finish()]
    times = [state.time_ns for state in smoothed]
    assert times == sorted(set(times)) and len(times) >= ROUND - 14


def test_a_frame_that_is_sought_says_why_the_last_search_was_refused(room, camera):
    localizer = Localizer(room.map, room.camera, camera, load_preset("default"))
    other = np.random.default_rng(4).permutation(camera.seen.descriptors)  # of another building
    camera.seen = Features(camera.seen.keypoints_px, camera.seen.scores, other)
    reasons = [localizer.process(k * FRAME_NS, camera.image.copy(), k).reason for k in range(ROUND)]
    assert reasons[1] == "searching"  # the first frame had time for itself; this one waits
    assert reasons[-1].startswith("searching; last refused: ")
    assert any(word in reasons[-1] for word in ("matches", "inliers", "alike"))
