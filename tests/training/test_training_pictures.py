"""Training's pictures: made by code, the same each time, with natural statistics, never a scene
that localizers are judged in."""

import itertools

import numpy as np
import pytest

from ground_station.feature_models import degrade, images
from ground_station.features.extractor import FeatureError
from ground_station.simulator import lighting, scenes, textures
from ground_station.simulator.textures import power_law_field
from ground_station.training import rooms

SIZE = (192, 256)


def slope(picture: np.ndarray) -> float:
    """The exponent of the amplitude spectrum, between 4 and 60 cycles a picture."""
    side = min(picture.shape)
    square = picture[:side, :side].astype(float)
    window = np.hanning(side)[:, None] * np.hanning(side)
    amplitude = np.abs(np.fft.fft2((square - square.mean()) * window))
    f = np.hypot(*np.meshgrid(np.fft.fftfreq(side), np.fft.fftfreq(side))) * side
    bins = np.geomspace(4, 60, 12)
    middle, mean = [], []
    for low, high in itertools.pairwise(bins):
        ring = (f >= low) & (f < high)
        middle.append(np.log(f[ring].mean()))
        mean.append(np.log(amplitude[ring].mean()))
    return float(np.polyfit(middle, mean, 1)[0])


def test_the_measure_of_the_slope_finds_a_known_one():
    for exponent in (0.7, 1.0, 1.4):
        field = power_law_field(256, exponent, np.random.default_rng(3))
        assert slope(field) == pytest.approx(-exponent, abs=0.12)


def test_pictures_have_the_spectrum_of_natural_ones_and_are_the_same_each_time():
    made = [images.procedural(5, index, SIZE) for index in range(8)]
    assert all(p.shape == SIZE and p.dtype == np.uint8 and p.std() > 10 for p in made)
    # Field 1987 and later: amplitude falls as 1/f^0.6 to 1/f^1.6, 1.1 in the mean.
    slopes = [slope(p) for p in made]
    assert -1.6 < np.mean(slopes) < -0.7, slopes
    again = images.procedural(5, 3, SIZE)
    assert (again == made[3]).all()
    assert (images.procedural(6, 3, SIZE) != made[3]).any()


def test_h264_gives_the_picture_back_and_a_coarser_quantizer_less_of_it():
    picture = images.procedural(5, 4, SIZE)
    error = [
        np.abs(degrade.round_trip([picture, picture], q).astype(int) - picture).mean()
        for q in (4, 24, 40)
    ]
    assert error[0] < 1 < error[1] < error[2]
    # It is predicted from the picture before: of one that stands still, nothing is left to send.
    other = images.procedural(5, 0, SIZE)
    last = degrade.round_trip([other, picture], 24)
    assert np.abs(last.astype(int) - picture).mean() < np.abs(last.astype(int) - other).mean()
    with pytest.raises(FeatureError, match="255x192"):
        degrade.round_trip([picture[:, :255]], 24)


def test_degrading_moves_nothing_and_is_a_function_of_its_seed():
    picture = images.procedural(5, 0, SIZE)
    first = degrade.degrade(picture, np.random.default_rng(1))
    assert (first == degrade.degrade(picture, np.random.default_rng(1))).all()
    rng = np.random.default_rng(2)
    moved = []
    for _ in range(24):
        seen = degrade.degrade(picture, rng)
        assert seen.shape == picture.shape and seen.dtype == np.uint8
        moved.append(shift(picture, seen))
    assert np.median(np.abs(moved)) <= 0.5


def shift(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """The whole pixels between two pictures by phase correlation."""
    window = np.hanning(first.shape[0])[:, None] * np.hanning(first.shape[1])
    a, b = (np.fft.fft2((p - p.mean()) * window) for p in (first.astype(float), second))
    cross = a * np.conj(b)
    peak = np.fft.ifft2(cross / np.maximum(np.abs(cross), 1e-9)).real
    at = np.array(np.unravel_index(peak.argmax(), peak.shape))
    return np.where(at > np.array(peak.shape) / 2, at - peak.shape, at)


def test_blur_keeps_the_light_and_the_place():
    point = np.zeros((31, 31), np.float32)
    point[15, 15] = 1
    y, x = np.mgrid[:31, :31]
    for blurred in (degrade.defocus(point, 3.0), degrade.motion_blur(point, (5.0, -2.0))):
        assert blurred.sum() == pytest.approx(1, abs=1e-5)
        assert (blurred * x).sum() == pytest.approx(15, abs=1e-3)
        assert (blurred * y).sum() == pytest.approx(15, abs=1e-3)
        assert blurred.max() < 0.5


def test_rooms_are_by_chance_and_none_is_one_that_localizers_are_judged_in():
    first, second = rooms.build_room(1, 0), rooms.build_room(1, 1)
    assert first.size_m != second.size_m
    assert rooms.build_room(1, 0).texture_seed == first.texture_seed
    for name in scenes.SCENES:
        judged = scenes.build(name, 10)
        for room in (first, second):
            assert room.size_m != judged.size_m and room.texture_seed != judged.texture_seed


def test_a_room_looks_otherwise_in_another_light_but_stands_where_it_stood(monkeypatch):
    monkeypatch.setattr(textures, "_FIELD_SIZE", 256)
    monkeypatch.setattr(lighting, "_SKY_DIRECTIONS", 8)
    monkeypatch.setattr(lighting, "_SUN_MAP_PX", 512)
    monkeypatch.setattr(lighting, "_GRID_M", 0.4)
    build = rooms.build_room
    monkeypatch.setattr(rooms, "build_room", lambda seed, number: build(seed, number, 25.0))
    stacks = list(rooms.views_of_room(1, 0, 2, 2, (96, 128)))
    assert [s.shape for s in stacks] == [(2, 96, 128)] * 2
    for stack in stacks:
        a, b = stack.astype(float)
        assert np.abs(a - b).mean() > 1  # the light
        edges = [np.hypot(*np.gradient(v)) for v in (a, b)]
        assert np.corrcoef(edges[0].ravel(), edges[1].ravel())[0, 1] > 0.5
    assert np.abs(stacks[0][0].astype(float) - stacks[1][0]).mean() > 5  # the place


def test_a_wide_blur_of_black_stays_a_picture(monkeypatch) -> None:
    """OpenCV blurs by a wide kernel in the frequency domain, which leaves black just below nought.

    (A negative number to a broken power is no number.)
    """
    picture = np.zeros((96, 128), np.uint8)
    picture[::9, ::7] = 255
    picture[40:, 60:] = 0
    for chance in ("_LIGHT", "_SHADOW", "_DEFOCUS", "_TONE", "_NOISE", "_COMPRESSION"):
        monkeypatch.setattr(degrade, chance, 0)
    monkeypatch.setattr(degrade, "_MOTION", 1)
    with np.errstate(invalid="raise"):
        for seed in range(200):
            degrade.degrade(picture, np.random.default_rng(seed))
