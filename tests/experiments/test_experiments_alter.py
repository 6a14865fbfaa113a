"""What happens to frames on their way."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from ground_station.experiments import alter, disturbances
from ground_station.experiments.disturbances.packets import PACKET_BYTES, Packets
from ground_station.geometry.camera import THESIS_CAMERA
from ground_station.recording.frames import Frame
from pi_firmware.wire.errors import ConfigError

IDR = b"\x00\x00\x00\x01\x65\x80" + bytes(10)
SLICE = b"\x00\x00\x00\x01\x41\x80" + bytes(10)


def frames(count):
    rng = np.random.default_rng(0)
    return [
        Frame(k, str(k), 10**9 + k * 10**8, rng.integers(50, 200, (48, 64), np.uint8), 0.01)
        for k in range(count)
    ]


def altered(**keys):
    return alter.Alteration.of(keys, "test")


def arrived_of(units, packet_loss, seed):
    return Packets(packet_loss).arrivals(lambda: units, seed)


def test_nothing_is_changed_without_an_alteration():
    given = frames(4)
    seen = list(altered().frames(given))
    assert [f.index for f in seen] == [0, 1, 2, 3]
    assert all(np.array_equal(a.image, b.image) for a, b in zip(given, seen, strict=True))
    assert [f.exposure_s for f in seen] == [0.01] * 4


def test_every_third_frame_keeps_its_index_and_time():
    seen = list(altered(every=3).frames(frames(8)))
    assert [(f.index, f.time_ns) for f in seen] == [(k, 10**9 + k * 10**8) for k in (0, 3, 6)]


def test_a_frame_is_told_a_time_that_is_off_by_chance_and_by_the_same_in_each_run():
    off = altered(stamp_error_s=0.002)
    told = [off.told_ns(f, 7) - f.time_ns for f in frames(400)]
    assert 1.8e6 < np.std(told) < 2.2e6 and abs(np.mean(told)) < 3e5
    assert told == [off.told_ns(f, 7) - f.time_ns for f in frames(400)]
    assert told != [off.told_ns(f, 8) - f.time_ns for f in frames(400)]
    assert all(altered().told_ns(f, 7) == f.time_ns for f in frames(4))


def test_the_covered_lens_is_black_for_just_that_time():
    alteration = altered(dark_from_s=0.2, dark_s=0.2)
    seen = list(alteration.frames(frames(6)))
    assert [not f.image.any() for f in seen] == [False, False, True, True, False, False]
    assert alteration.blind_until_s == 0.4 and altered(dark_from_s=0.2).blind_until_s is None


def test_a_blurred_picture_has_its_mean_and_less_contrast():
    (plain,) = altered().frames(frames(1))
    (blurred,) = altered(blur_px=2.0).frames(frames(1))
    assert abs(float(plain.image.mean()) - float(blurred.image.mean())) < 2
    assert blurred.image.std() < 0.3 * plain.image.std()


def test_a_shrunk_picture_and_its_camera_show_a_point_at_the_same_place():
    half = altered(scale=0.5)
    camera = half.camera(THESIS_CAMERA)
    (shrunk,) = half.frames([Frame(0, "0", 0, np.zeros((480, 640), np.uint8))])
    assert shrunk.image.shape == (camera.height_px, camera.width_px) == (240, 320)
    points = np.array([[0.3, -0.2, 1.0], [-0.5, 0.4, 1.5], [0.0, 0.0, 2.0]])
    large, small = THESIS_CAMERA.project(points), camera.project(points)
    # The corner of the picture stays where it is, and pixels are counted from their centres.
    assert np.allclose((large + 0.5) / 2, small + 0.5, atol=1e-9)
    assert altered(scale=1.0).camera(THESIS_CAMERA) == THESIS_CAMERA
    assert camera.readout_s == THESIS_CAMERA.readout_s


def test_frames_that_did_not_arrive_are_not_seen():
    seen = list(altered().frames(frames(4), np.array([True, False, False, True])))
    assert [f.index for f in seen] == [0, 3]


def test_a_stream_without_losses_arrives_whole_from_its_first_idr():
    assert arrived_of([SLICE, IDR, SLICE, SLICE], 0.0, 0).tolist() == [False, True, True, True]


def test_what_follows_a_lost_packet_is_useless_until_the_next_idr():
    units = ([IDR] + [SLICE] * 9) * 200
    arrived = arrived_of(units, 0.05, 3)
    again = arrived_of(units, 0.05, 3)
    assert np.array_equal(arrived, again) and not np.array_equal(
        arrived, arrived_of(units, 0.05, 4)
    )
    for group in arrived.reshape(-1, 10):
        assert not (np.diff(group.astype(int)) > 0).any()  # once lost, lost to the group's end
    # Of group position k, k + 1 units must have come: 0.95^(k+1) in the mean.
    expected = np.mean([0.95 ** (k + 1) for k in range(10)])
    assert abs(arrived.mean() - expected) < 0.05


@pytest.mark.parametrize(("size", "packets"), [(PACKET_BYTES, 1), (PACKET_BYTES + 1, 2)])
def test_a_unit_of_more_packets_is_lost_more_often(size, packets):
    unit = IDR + bytes(size - len(IDR))
    arrived = arrived_of([unit] * 4000, 0.3, 1)
    assert abs(arrived.mean() - 0.7**packets) < 0.03


def test_an_unknown_key_is_refused_with_the_known_ones():
    with pytest.raises(
        ConfigError, match=r"test: unknown key 'alter\.fog' \(known here: blur_px, "
    ):
        altered(fog=1.0)
    with pytest.raises(ConfigError, match=r"test: alter: 'blur_px' is 99\.0; allowed: 0\.0 to 50"):
        altered(blur_px=99.0)


def test_a_disturbance_is_a_file_of_its_own(tmp_path, monkeypatch):
    """Nothing else is touched to add one."""
    (tmp_path / "fog.py").write_text(
        "from dataclasses import dataclass\n"
        "from ground_station.experiments.disturbance import Disturbance\n"
        "@dataclass(frozen=True)\n"
        "class Fog(Disturbance):\n"
        "    fog: float = 0.0\n"
        "    def picture(self, image, time_s):\n"
        "        return (image * (1 - self.fog) + 200 * self.fog).astype(image.dtype)\n"
        "DISTURBANCE = Fog\n"
    )
    monkeypatch.setattr(disturbances, "__path__", [*disturbances.__path__, str(tmp_path)])
    alter.kinds.cache_clear()
    try:
        (seen,) = altered(fog=1.0, every=2).frames(frames(2))
    finally:
        alter.kinds.cache_clear()
        sys.modules.pop(f"{disturbances.__name__}.fog", None)
    assert (seen.image == 200).all()
