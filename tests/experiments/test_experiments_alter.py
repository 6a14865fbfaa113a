"""What happens to frames on their way."""

from __future__ import annotations

import numpy as np
import pytest

from ground_station.experiments.alter import (
    PACKET_BYTES,
    altered,
    arrivals,
    is_dark,
    scaled_camera,
    told_ns,
)
from ground_station.experiments.declaration import Alteration
from ground_station.geometry.camera import THESIS_CAMERA
from ground_station.recording.frames import Frame

IDR = b"\x00\x00\x00\x01\x65\x80" + bytes(10)
SLICE = b"\x00\x00\x00\x01\x41\x80" + bytes(10)


def frames(count):
    rng = np.random.default_rng(0)
    return [
        Frame(k, str(k), 10**9 + k * 10**8, rng.integers(50, 200, (48, 64), np.uint8), 0.01)
        for k in range(count)
    ]


def test_nothing_is_changed_without_an_alteration():
    given = frames(4)
    seen = list(altered(given, Alteration()))
    assert [f.index for f in seen] == [0, 1, 2, 3]
    assert all(np.array_equal(a.image, b.image) for a, b in zip(given, seen, strict=True))
    assert [f.exposure_s for f in seen] == [0.01] * 4


def test_every_third_frame_keeps_its_index_and_time():
    seen = list(altered(frames(8), Alteration(every=3)))
    assert [(f.index, f.time_ns) for f in seen] == [(k, 10**9 + k * 10**8) for k in (0, 3, 6)]


def test_a_frame_is_told_a_time_that_is_off_by_chance_and_by_the_same_in_each_run():
    off = Alteration(stamp_error_s=0.002)
    told = [told_ns(f, off, 7) - f.time_ns for f in frames(400)]
    assert 1.8e6 < np.std(told) < 2.2e6 and abs(np.mean(told)) < 3e5
    assert told == [told_ns(f, off, 7) - f.time_ns for f in frames(400)]
    assert told != [told_ns(f, off, 8) - f.time_ns for f in frames(400)]
    assert all(told_ns(f, Alteration(), 7) == f.time_ns for f in frames(4))


def test_the_covered_lens_is_black_for_just_that_time():
    alteration = Alteration(dark_from_s=0.2, dark_s=0.2)
    seen = list(altered(frames(6), alteration))
    assert [not f.image.any() for f in seen] == [False, False, True, True, False, False]
    assert not any(is_dark(Alteration(), t) for t in (0.0, 0.1))


def test_a_blurred_picture_has_its_mean_and_less_contrast():
    (plain,) = altered(frames(1), Alteration())
    (blurred,) = altered(frames(1), Alteration(blur_px=2.0))
    assert abs(float(plain.image.mean()) - float(blurred.image.mean())) < 2
    assert blurred.image.std() < 0.3 * plain.image.std()


def test_a_shrunk_picture_and_its_camera_show_a_point_at_the_same_place():
    camera = scaled_camera(THESIS_CAMERA, 0.5)
    (shrunk,) = altered([Frame(0, "0", 0, np.zeros((480, 640), np.uint8))], Alteration(scale=0.5))
    assert shrunk.image.shape == (camera.height_px, camera.width_px) == (240, 320)
    points = np.array([[0.3, -0.2, 1.0], [-0.5, 0.4, 1.5], [0.0, 0.0, 2.0]])
    whole, half = THESIS_CAMERA.project(points), camera.project(points)
    # The corner of the picture stays where it is, and pixels are counted from their centres.
    assert np.allclose((whole + 0.5) / 2, half + 0.5, atol=1e-9)
    assert scaled_camera(THESIS_CAMERA, 1.0) is THESIS_CAMERA
    assert camera.readout_s == THESIS_CAMERA.readout_s


def test_frames_that_did_not_arrive_are_not_seen():
    seen = list(altered(frames(4), Alteration(), np.array([True, False, False, True])))
    assert [f.index for f in seen] == [0, 3]


def test_a_stream_without_losses_arrives_whole_from_its_first_idr():
    assert arrivals([SLICE, IDR, SLICE, SLICE], 0.0, 0).tolist() == [False, True, True, True]


def test_what_follows_a_lost_packet_is_useless_until_the_next_idr():
    units = ([IDR] + [SLICE] * 9) * 200
    arrived = arrivals(units, 0.05, 3)
    again = arrivals(units, 0.05, 3)
    assert np.array_equal(arrived, again) and not np.array_equal(arrived, arrivals(units, 0.05, 4))
    for group in arrived.reshape(-1, 10):
        assert not (np.diff(group.astype(int)) > 0).any()  # once lost, lost to the group's end
    # Of group position k, k + 1 units must have come: 0.95^(k+1) in the mean.
    expected = np.mean([0.95 ** (k + 1) for k in range(10)])
    assert abs(arrived.mean() - expected) < 0.05


@pytest.mark.parametrize(("size", "packets"), [(PACKET_BYTES, 1), (PACKET_BYTES + 1, 2)])
def test_a_unit_of_more_packets_is_lost_more_often(size, packets):
    unit = IDR + bytes(size - len(IDR))
    arrived = arrivals([unit] * 4000, 0.3, 1)
    assert abs(arrived.mean() - 0.7**packets) < 0.03
