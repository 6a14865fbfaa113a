"""Features on disk are those of memory to the bit, and whoever compares them reads them there."""

from __future__ import annotations

import dataclasses
import os
import pickle
from pathlib import Path

import numpy as np
import pytest

from ground_station.errors import MapError
from ground_station.features.extractor import Features
from ground_station.geometry.camera import THESIS_CAMERA
from ground_station.mapping.construction import verification
from ground_station.mapping.construction.build import build_map, structure_key
from ground_station.mapping.construction.feature_file import FeatureFile
from ground_station.mapping.construction.images import extract
from ground_station.mapping.construction.lens import with_lens
from ground_station.mapping.construction.verification import match
from ground_station.mapping.construction.workers import Threads
from ground_station.mapping.settings import MappingSettings
from ground_station.recording.frames import Frame
from ground_station.recording.open import open_input, parse_range

SETTINGS = MappingSettings(max_features=300, threads=2)
SAMPLE = Path(__file__).parents[3] / "maps/atrium/mapping.mcap"
RNG = np.random.default_rng(3)


def _features(count, dimension=16):
    return Features(
        RNG.uniform(0, 640, (count, 2)).astype(np.float32),
        RNG.random(count).astype(np.float32),
        RNG.normal(size=(count, dimension)).astype(np.float32),
    )


def _same(a, b):
    return all(
        np.array_equal(getattr(a, name), getattr(b, name))
        for name in ("keypoints_px", "scores", "descriptors")
    )


def _mapped_bytes(path):
    """How much of a file this process has mapped."""
    lines = Path("/proc/self/maps").read_text().splitlines()
    spans = [line.split()[0].split("-") for line in lines if line.endswith(str(path))]
    return sum(int(last, 16) - int(first, 16) for first, last in spans)


def test_features_come_back_to_the_bit_in_whatever_order_they_were_put(tmp_path):
    given = [_features(count) for count in (30, 0, 7, 211)]
    file = FeatureFile(tmp_path / "new")
    for k in (2, 0, 3, 1):
        file.put(k, given[k])
    kept = file.close()
    assert len(kept) == 4 and all(_same(a, b) for a, b in zip(given, kept, strict=True))
    assert _same(kept[-1], given[3]) and [len(f) for f in kept[1:3]] == [0, 7]
    with pytest.raises(IndexError):
        kept[4]


def test_an_image_is_mapped_only_while_somebody_looks_at_it(tmp_path):
    file = FeatureFile(tmp_path)
    for k in range(50):
        file.put(k, _features(1000))
    kept = file.close()
    for features in kept:
        assert features.descriptors.any()
    held = kept[7]
    one_image = 4 * 1000 * (16 + 3)
    assert 0 < _mapped_bytes(tmp_path / "features.bin") < 3 * one_image
    del held, features
    assert _mapped_bytes(tmp_path / "features.bin") == 0


def test_what_a_comparison_is_sent_is_small_and_leads_to_the_same(tmp_path):
    given = [_features(500, 128), _features(0, 128)]
    file = FeatureFile(tmp_path)
    for k, features in enumerate(given):
        file.put(k, features)
    pixels = [features.keypoints_px.astype(np.float64) + 0.1 for features in given]
    sides = file.close().sides(pixels)
    assert len(pickle.dumps(sides)) < 1000
    for side, features, px in zip(pickle.loads(pickle.dumps(sides)), given, pixels, strict=True):
        descriptors, loaded = side.load()
        assert np.array_equal(descriptors, features.descriptors) and np.array_equal(loaded, px)


class _FarAway(Threads):
    """Workers that cannot read this machine's files: what they get was pickled."""

    here = False

    def __init__(self):
        super().__init__(2)
        self.sent = 0

    def map(self, function, items):
        def pickled():
            for item in items:
                data = pickle.dumps(item)
                assert b"features.bin" not in data
                self.sent += len(data)
                yield pickle.loads(data)

        return super().map(function, pickled())


def test_structure_from_motion_starts_from_the_same_wherever_features_lie(tmp_path):
    source = open_input(SAMPLE, 30.0, parse_range("0:6"))
    frames, camera = list(source), source.camera
    memory = extract(frames, camera, SETTINGS, Threads(2), None)
    disk = extract(frames, camera, SETTINGS, Threads(2), None, folder=tmp_path)
    assert all(_same(a, b) for a, b in zip(memory.features, disk.features, strict=True))
    expected = structure_key(memory, match(memory, camera, SETTINGS, Threads(2)), camera, SETTINGS)
    far = _FarAway()
    for workers in (Threads(2), far):
        pairs = match(disk, camera, SETTINGS, workers)
        assert structure_key(disk, pairs, camera, SETTINGS) == expected
    assert far.sent > 300 * 128 * 4  # the descriptors themselves


def test_what_descriptors_say_of_a_pair_is_asked_once_whatever_the_lens(monkeypatch):
    source = open_input(SAMPLE, 30.0, parse_range("0:24"))
    camera = source.camera
    longer = dataclasses.replace(camera, fx_px=1.05 * camera.fx_px, fy_px=1.05 * camera.fy_px)
    images = extract(list(source), camera, SETTINGS, Threads(2), None)
    matched: dict[tuple[int, int], np.ndarray] = {}
    first = match(images, camera, SETTINGS, Threads(2), matched=matched)
    unlike = {pair for pair, matches in matched.items() if not len(matches)}
    assert len(unlike) > 20 and first.keys() <= matched.keys() - unlike
    images = with_lens(images, longer)
    fresh = match(images, longer, SETTINGS, Threads(2))
    monkeypatch.setattr(verification, "mutual_matches", None)
    again = match(images, longer, SETTINGS, Threads(2), matched=matched)
    assert structure_key(images, again, longer, SETTINGS) == structure_key(
        images, fresh, longer, SETTINGS
    )


def test_a_disk_that_refuses_is_one_line_and_leaves_no_map(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(FeatureFile, "put", full)
    frames = [
        Frame(k, f"{k}.png", k * 10**8, RNG.integers(0, 256, (480, 640), dtype=np.uint8))
        for k in range(2)
    ]
    with pytest.raises(MapError, match="No space left on device") as caught:
        build_map(frames, THESIS_CAMERA, SETTINGS, tmp_path / "map")
    assert "\n" not in str(caught.value) and not (tmp_path / "map").exists()
