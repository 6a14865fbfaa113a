"""Frames that show nothing: what they are."""

from __future__ import annotations

import numpy as np
import pytest

from ground_station.localization import gate
from ground_station.localization.settings import GateSettings, load_preset
from pi_firmware.wire.entropy import entropy_bits

SIZE = (480, 640)
LEAST = load_preset("default").gate.min_contrast


def noise(mean: float, sigma: float, seed: int = 0) -> np.ndarray:
    drawn = np.random.default_rng(seed).normal(mean, sigma, SIZE)
    return np.clip(drawn, 0, 255).astype(np.uint8)


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
