"""The gate: its entropy is Shannon's, and its decisions account for every frame."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from skimage.measure import shannon_entropy

from pi_firmware import gstreamer
from pi_firmware.gate import (
    Gate,
    Measure,
    Verdict,
    attach_luma,
    block_means,
    gradient_energy,
    luma_branch,
    measure,
)
from pi_firmware.settings import CameraSettings, GateSettings
from pi_firmware.wire.entropy import entropy_bits
from pi_firmware.wire.messages import Reason

FRAME_NS = 33_333_333


@settings(deadline=None, max_examples=60)
@given(arrays(np.uint8, st.tuples(st.integers(1, 40), st.integers(1, 40))))
def test_entropy_equals_scikit_images(luma: np.ndarray) -> None:
    assert entropy_bits(luma) == pytest.approx(shannon_entropy(luma, base=2), abs=1e-9)


def test_entropy_of_every_grey_level_alike_is_eight_bits() -> None:
    levels = np.arange(256, dtype=np.uint8)
    assert entropy_bits(np.tile(levels, (8, 1))) == pytest.approx(8.0)
    assert entropy_bits(np.full((48, 64), 17, np.uint8)) == 0.0


def test_gradient_energy_is_the_mean_square_of_neighbours_differences() -> None:
    ramp = np.tile(np.arange(0, 128, 2, dtype=np.uint8), (48, 1))  # dx = 2, dy = 0
    assert gradient_energy(ramp) == pytest.approx(4.0)
    assert gradient_energy(ramp.T.copy()) == pytest.approx(4.0)


def test_block_means_are_those_of_four_by_four_pixels() -> None:
    luma = np.arange(9 * 14, dtype=np.uint8).reshape(9, 14)
    expected = luma[:8, :12].reshape(2, 4, 3, 4).mean(axis=(1, 3))
    assert block_means(luma) == pytest.approx(expected)
    assert block_means(np.full((120, 160), 255, np.uint8)).max() == 255.0


def rich(
    entropy_bits: float = 7.0, sharpness: float = 100.0, level: float | None = None
) -> Measure:
    """A frame's figures; without a level, none is like another."""
    rich.count += 1  # type: ignore[attr-defined]
    grey = 10.0 * (rich.count % 20) if level is None else level  # type: ignore[attr-defined]
    return Measure(entropy_bits, sharpness, np.full((30, 40), grey, np.float32))


rich.count = 0  # type: ignore[attr-defined]


def decisions(gate: Gate, frames: list[Measure], period_ns: int = FRAME_NS) -> list[Verdict]:
    return [gate.decide(frame, index * period_ns) for index, frame in enumerate(frames)]


def passes(verdicts: list[Verdict]) -> list[bool]:
    return [verdict.passed for verdict in verdicts]


def test_gate_reopens_only_above_the_hysteresis() -> None:
    gate = Gate(GateSettings(min_entropy_bits=6.0, hysteresis_bits=0.5, heartbeat_s=0.0))
    entropies = [6.0, 5.99, 6.2, 6.49, 6.5, 6.1, 5.9]
    verdicts = decisions(gate, [rich(e) for e in entropies])
    assert passes(verdicts) == [True, False, False, False, True, True, False]
    assert {v.reason for v in verdicts if not v.passed} == {Reason.ENTROPY}


def test_a_frame_far_blurrier_than_those_before_is_gated_until_it_is_sharp_again() -> None:
    gate = Gate(GateSettings(min_sharpness_ratio=0.5, heartbeat_s=0.0))
    sharpness = [100.0] * 20 + [51.0, 49.0, 59.0, 61.0, 100.0]
    verdicts = decisions(gate, [rich(sharpness=s) for s in sharpness])
    assert passes(verdicts) == [True] * 21 + [False, False, True, True]
    assert verdicts[21].reason is verdicts[22].reason is Reason.BLUR


def test_a_plain_scene_is_no_blur_once_it_has_lasted() -> None:
    gate = Gate(GateSettings(heartbeat_s=0.0))
    verdicts = decisions(gate, [rich(sharpness=s) for s in [100.0] * 60 + [10.0] * 60])
    assert not passes(verdicts)[60]
    assert all(passes(verdicts)[95:])


def test_nothing_is_called_blurred_before_there_is_something_to_compare_with() -> None:
    gate = Gate(GateSettings(heartbeat_s=0.0))
    assert all(passes(decisions(gate, [rich(sharpness=s) for s in [100.0] * 5 + [1.0] * 4])))


def test_a_frame_like_the_last_one_sent_is_gated_but_slow_drift_is_not() -> None:
    gate = Gate(GateSettings(min_difference=1.0, heartbeat_s=0.0))
    verdicts = decisions(gate, [rich(level=100 + 0.4 * index) for index in range(10)])
    assert passes(verdicts) == [index % 3 == 0 for index in range(10)]
    assert verdicts[0].difference is None
    assert verdicts[3].difference == pytest.approx(1.2, abs=1e-4)
    assert verdicts[1].reason is Reason.DUPLICATE


def test_each_test_can_be_switched_off() -> None:
    limits = GateSettings(
        min_entropy_bits=0.0, min_sharpness_ratio=0.0, min_difference=0.0, heartbeat_s=0.0
    )
    frames = [rich(level=5.0) for _ in range(20)] + [rich(0.0, 0.0, level=5.0)] * 5
    assert all(passes(decisions(Gate(limits), frames)))


def test_heartbeat_comes_once_a_period_while_all_is_gated() -> None:
    verdicts = decisions(Gate(GateSettings(heartbeat_s=1.0)), [rich(0.0)] * 35, 100_000_000)
    beats = [i for i, verdict in enumerate(verdicts) if verdict.heartbeat]
    assert beats == [10, 20, 30]
    assert [i for i, verdict in enumerate(verdicts) if verdict.passed] == beats
    assert {verdict.reason for verdict in verdicts} == {Reason.ENTROPY}


def test_a_camera_that_stares_at_one_scene_beats_each_second() -> None:
    verdicts = decisions(Gate(GateSettings()), [rich(level=50.0)] * 91)
    assert [i for i, v in enumerate(verdicts) if v.passed] == [0, 31, 62]


def test_heartbeat_counts_from_the_last_frame_sent() -> None:
    gate = Gate(GateSettings(heartbeat_s=0.5))
    passed = gate.decide(rich(8.0), 900_000_000)
    assert passed.passed and not passed.heartbeat
    assert not gate.decide(rich(0.0), 1_300_000_000).passed
    assert gate.decide(rich(0.0), 1_400_000_000).heartbeat


def test_no_heartbeat_when_it_is_off() -> None:
    verdicts = decisions(Gate(GateSettings(heartbeat_s=0.0)), [rich(0.0)] * 20, 10**9)
    assert not any(passes(verdicts))


def test_disabled_gate_passes_everything() -> None:
    verdicts = decisions(Gate(GateSettings(enabled=False)), [rich(0.0, 0.0, level=0.0)] * 20)
    assert all(passes(verdicts))


def scaled(luma: np.ndarray, colorimetry: str = "bt601") -> np.ndarray:
    """What the measuring branch delivers for one picture."""
    height, width = luma.shape
    camera = CameraSettings(width_px=width, height_px=height)
    gst = gstreamer.load()
    pipeline = gstreamer.launch(
        "appsrc name=source format=time "
        f"caps=video/x-raw,format=I420,width={width},height={height},framerate=30/1"
        f",colorimetry=(string){colorimetry} "
        f"! {luma_branch(camera)} ! fakesink name=whole sync=false async=false"
    )
    seen, order = [], []
    attach_luma(pipeline, camera, lambda low, ns: (seen.append(low), order.append("low")))
    whole = pipeline.get_by_name("whole").get_static_pad("sink")
    ok = gst.PadProbeReturn.OK
    whole.add_probe(gst.PadProbeType.BUFFER, lambda *_: (order.append("whole"), ok)[1])
    pipeline.set_state(gst.State.PLAYING)
    source = pipeline.get_by_name("source")
    rows = np.zeros((height, -(-width // 4) * 4), np.uint8)
    rows[:, :width] = luma
    chroma = np.full(-(-width // 8) * 4 * height // 2 * 2, 128, np.uint8)
    for index in range(3):
        buffer = gst.Buffer.new_wrapped(rows.tobytes() + chroma.tobytes())
        buffer.pts = index * FRAME_NS
        source.emit("push-buffer", buffer)
    source.emit("end-of-stream")
    kinds = gst.MessageType.EOS | gst.MessageType.ERROR
    message = pipeline.get_bus().timed_pop_filtered(5 * gst.SECOND, kinds)
    pipeline.set_state(gst.State.NULL)
    assert message is not None and message.type == gst.MessageType.EOS
    assert order == ["low", "whole"] * 3  # measured before the frame goes on
    return seen[-1]


@pytest.mark.parametrize("colorimetry", ["bt601", "bt709", "1:4:7:1"])
@pytest.mark.parametrize("size", [(640, 480), (320, 240), (64, 48), (1280, 720), (642, 482)])
def test_the_scaled_luma_is_made_of_the_pictures_own_pixels(
    size: tuple[int, int], colorimetry: str
) -> None:
    width, height = size
    luma = np.zeros((height, width), np.uint8)
    luma[:] = np.linspace(0, 250, width).astype(np.uint8)
    low = scaled(luma, colorimetry)
    assert low.shape[1] % 4 == 0 and low.shape[1] <= 320
    at = (np.arange(low.shape[1]) + 0.5) * width / low.shape[1]
    assert low[0].astype(int) == pytest.approx(at * 250 / width, abs=250 / low.shape[1] + 1.5)


def test_low_resolution_keeps_the_entropy_of_the_whole_picture() -> None:
    rng = np.random.default_rng(3)
    v, u = np.mgrid[0:480, 0:640]
    luma = np.clip(120 + 60 * np.sin(u / 40) + v / 8 + rng.normal(0, 3, u.shape), 0, 255)
    luma = luma.astype(np.uint8)
    whole = shannon_entropy(luma, base=2)
    assert measure(scaled(luma)).entropy_bits == pytest.approx(whole, abs=0.05)


def test_blur_lowers_the_sharpness_of_the_scaled_luma() -> None:
    rng = np.random.default_rng(1)
    v, u = np.mgrid[0:480, 0:640]
    boxes = (rng.integers(0, 2, (60, 80))[v // 8, u // 8] * 150 + 50).astype(np.uint8)
    wide = np.pad(boxes.astype(float), ((0, 0), (16, 16)), mode="edge").cumsum(axis=1)
    blurred = ((wide[:, 32:] - wide[:, :-32])[:, :640] / 32).astype(np.uint8)
    assert measure(scaled(blurred)).sharpness < 0.3 * measure(scaled(boxes)).sharpness
