"""Frames that show nothing: what they are, and what a covered lens costs once it is free again."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from synthetic import FakeExtractor, apart

from ground_station.localization import gate
from ground_station.localization.estimate import State
from ground_station.localization.localizer import Localizer
from ground_station.localization.settings import GateSettings, load_preset
from pi_firmware.wire.entropy import entropy_bits

SIZE = (480, 640)
RATE_HZ = 30.0
LEAST = load_preset("default").gate.min_contrast


def noise(mean: float, sigma: float, seed: int = 0) -> np.ndarray:
    drawn = np.random.default_rng(seed).normal(mean, sigma, SIZE)
    return np.clip(drawn, 0, 255).astype(np.uint8)


class Standing(FakeExtractor):
    """A camera that stands still: the features of its only view, and how often they were asked."""

    def __init__(self, room, wTc):
        self.room, self.wTc, self.asked = room, wTc, 0

    def extract(self, image):
        self.asked += 1
        return self.room.features(self.wTc)


def test_entropy_is_the_payloads_of_any_picture():
    for image in (noise(90.0, 40.0), noise(3.0, 1.0)[:101, :33], np.full(SIZE, 9, np.uint8)):
        assert gate.entropy_bits(image) == pytest.approx(entropy_bits(image), abs=1e-12)


@pytest.mark.parametrize("mean", [3.0, 40.0, 250.0])
def test_a_sensors_noise_is_nothing_however_dark_or_bright(mean):
    assert gate.low_contrast(noise(mean, 3.0), GateSettings(min_contrast=LEAST)).startswith(
        "contrast"
    )


def test_one_small_thing_on_a_wall_is_something():
    wall = np.full(SIZE, 240, np.uint8)
    assert gate.contrast(wall) == 0.0
    wall[101:115, 303:317] = 60  # of 14 px: a whole block lies in it wherever it is
    assert gate.contrast(wall) == 180.0
    assert gate.low_contrast(wall, GateSettings(min_contrast=LEAST)) == ""
    slope = np.tile(np.linspace(100, 100 + 3 * LEAST, SIZE[1]), (SIZE[0], 1)).astype(np.uint8)
    assert gate.low_contrast(slope, GateSettings(min_contrast=LEAST)) == "", (
        "a soft picture is one, too"
    )


def test_without_a_limit_nothing_is_gated():
    assert gate.low_contrast(noise(3.0, 0.0), GateSettings()) == ""
    assert gate.low_entropy(0.0, GateSettings()) == ""
    reason = gate.low_entropy(6.994, GateSettings(min_entropy_bits=7.0))
    assert reason == "entropy 6.99 below 7 bits"


@pytest.mark.parametrize("shape", [(480, 640), (5, 7), (1, 1)])
def test_any_size_has_a_contrast(shape):
    assert gate.contrast(np.full(shape, 9, np.uint8)) == 0.0


@pytest.mark.parametrize(("covered", "lost"), [(6, False), (60, True)])
def test_the_first_frame_after_a_covered_lens_has_a_pose(room, covered, lost):
    """A frame that shows nothing is not searched: the search would still run when light is back."""
    _, path = room.path(1)
    extractor = Standing(room, path[0])
    localizer = Localizer(room.map, room.camera, extractor, load_preset("default"))
    scene = cv2.GaussianBlur(noise(120, 90), (0, 0), 2.0)
    dark = noise(3.0, 3.0)
    seen = [scene] * 30 + [dark] * covered + [scene] * 15
    said = []
    for k, image in enumerate(seen):
        if k == 30:
            localizer._worker.drop()  # what still runs for a frame of before may ask, too
            asked = extractor.asked
        if k == 30 + covered:
            assert extractor.asked == asked
        said.append(localizer.process(round(k * 1e9 / RATE_HZ), image, k))
    assert said[29].state is State.TRACKING, said[29].reason
    night, after = said[30 : 30 + covered], said[30 + covered :]
    assert not any(e.localized or e.state is State.TRACKING for e in night)
    assert all(e.gated and "grey levels" in e.reason for e in night)
    assert (night[-1].state is State.LOST) == lost
    assert after[0].localized and after[0].relocalized == lost, after[0].reason
    assert all(e.localized for e in after) and after[-1].state is State.TRACKING
    assert apart(after[-1].wTc, path[0])[0] < 0.03
