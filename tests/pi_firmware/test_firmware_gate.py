"""The gate: its entropy is Shannon's, and its decisions account for every frame."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from skimage.measure import shannon_entropy

from pi_firmware.gate import Decision, Gate, gradient_energy, measure
from pi_firmware.settings import GateSettings
from pi_firmware.wire.entropy import entropy_bits

FRAME_NS = 33_333_333


@settings(deadline=None, max_examples=60)
@given(arrays(np.uint8, st.tuples(st.integers(1, 40), st.integers(1, 40))))
def test_entropy_equals_scikit_images(luma: np.ndarray) -> None:
    assert entropy_bits(luma) == pytest.approx(shannon_entropy(luma, base=2), abs=1e-9)


def test_entropy_of_every_grey_level_alike_is_eight_bits() -> None:
    levels = np.arange(256, dtype=np.uint8)
    assert entropy_bits(np.tile(levels, (8, 1))) == pytest.approx(8.0)
    assert entropy_bits(np.full((48, 64), 17, np.uint8)) == 0.0


def test_low_resolution_keeps_the_entropy_of_the_whole_picture() -> None:
    rng = np.random.default_rng(3)
    v, u = np.mgrid[0:480, 0:640]
    luma = np.clip(120 + 60 * np.sin(u / 40) + v / 8 + rng.normal(0, 3, u.shape), 0, 255)
    luma = luma.astype(np.uint8)
    whole = shannon_entropy(luma, base=2)
    assert measure(luma).entropy_bits == pytest.approx(whole, abs=0.05)


def test_gradient_energy_is_the_mean_square_of_neighbours_differences() -> None:
    ramp = np.tile(np.arange(0, 128, 2, dtype=np.uint8), (48, 1))  # dx = 2, dy = 0
    assert gradient_energy(ramp) == pytest.approx(4.0)
    assert gradient_energy(ramp.T.copy(), step=4) == pytest.approx(4.0)


def test_blur_lowers_sharpness_and_keeps_the_decision_with_entropy() -> None:
    rng = np.random.default_rng(1)
    sharp = rng.integers(0, 256, (480, 640), dtype=np.uint8)
    blurred = ((sharp[:, :-1].astype(int) + sharp[:, 1:]) // 2).astype(np.uint8)
    assert measure(blurred).sharpness < 0.7 * measure(sharp).sharpness
    assert Gate(GateSettings()).decide(measure(blurred).entropy_bits, 0) is Decision.PASS


def test_gate_reopens_only_above_the_hysteresis() -> None:
    gate = Gate(GateSettings(min_entropy_bits=5.0, hysteresis_bits=0.2, heartbeat_s=0.0))
    entropies = [5.0, 4.99, 5.1, 5.19, 5.2, 5.05, 4.9]
    passed = [gate.decide(e, i * FRAME_NS) is Decision.PASS for i, e in enumerate(entropies)]
    assert passed == [True, False, False, False, True, True, False]


def test_heartbeat_comes_once_a_period_while_all_is_gated() -> None:
    gate = Gate(GateSettings(heartbeat_s=1.0))
    decisions = [gate.decide(0.0, index * 100_000_000) for index in range(35)]
    beats = [index for index, decision in enumerate(decisions) if decision is Decision.HEARTBEAT]
    assert beats == [10, 20, 30]
    assert set(decisions) == {Decision.GATED, Decision.HEARTBEAT}


def test_heartbeat_counts_from_the_last_frame_sent() -> None:
    gate = Gate(GateSettings(heartbeat_s=0.5))
    assert gate.decide(8.0, 900_000_000) is Decision.PASS
    assert gate.decide(0.0, 1_300_000_000) is Decision.GATED
    assert gate.decide(0.0, 1_400_000_000) is Decision.HEARTBEAT


def test_no_heartbeat_when_it_is_off() -> None:
    gate = Gate(GateSettings(heartbeat_s=0.0))
    assert all(gate.decide(0.0, i * 10**9) is Decision.GATED for i in range(20))


def test_disabled_gate_passes_everything() -> None:
    gate = Gate(GateSettings(enabled=False))
    assert all(gate.decide(0.0, i * FRAME_NS) is Decision.PASS for i in range(5))
