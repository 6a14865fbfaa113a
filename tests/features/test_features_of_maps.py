"""A map is localized in with the features that it was built with, or refused by name."""

from __future__ import annotations

from dataclasses import replace

import made_up
import numpy as np
import pytest

from ground_station.errors import MapError
from ground_station.features import catalogue, extractors
from ground_station.features.extractor import FeatureError
from ground_station.features.settings import FeatureSettings, LearnedSettings
from ground_station.geometry.camera import THESIS_CAMERA
from ground_station.localization.extraction import extractor_for
from ground_station.map.store import MapInfo
from ground_station.mapping.construction import images, verification
from ground_station.mapping.construction.workers import Threads
from ground_station.mapping.settings import MappingSettings
from ground_station.recording.frames import Frame

CAMERA = replace(THESIS_CAMERA, width_px=96, height_px=64)


def frames_of_noise(count: int) -> list[Frame]:
    rng = np.random.default_rng(0)
    return [
        Frame(k, f"{k}.png", k * 10**8, rng.integers(0, 256, (64, 96), dtype=np.uint8))
        for k in range(count)
    ]


@pytest.fixture
def bird(tmp_path, monkeypatch):
    """The map of a model among the user's."""
    monkeypatch.setattr(catalogue, "SHIPPED", tmp_path / "none")
    monkeypatch.setenv("BLIMP_MODELS", str(tmp_path))
    made_up.write_cells(tmp_path, made_up.info("bird"))
    return MapInfo("bird", catalogue.find("bird").sha256, 16, THESIS_CAMERA, name="hall")


def test_by_default_the_maps_own_features_are_taken(bird):
    found = extractor_for(bird, FeatureSettings(max_features=70))
    assert (found.name, found.sha256, found.max_features) == ("bird", bird.features_sha256, 70)
    sift = MapInfo("rootsift", extractors.create("rootsift").sha256, 128, THESIS_CAMERA)
    assert extractor_for(sift, FeatureSettings()).name == "rootsift"


def test_the_settings_of_the_network_reach_it(bird):
    settings = FeatureSettings(learned=LearnedSettings(nms_px=9, threshold=0.2))
    found = extractor_for(bird, settings)
    assert (found.nms_px, found.threshold) == (9, 0.2)
    with pytest.raises(FeatureError, match="provider 'quantum'"):
        extractor_for(bird, replace(settings, learned=LearnedSettings(provider="quantum")))


def test_a_map_of_other_features_than_the_settings_is_refused_by_name(bird):
    with pytest.raises(MapError, match=r"'hall' was built with 'bird' .* uses 'rootsift'"):
        extractor_for(bird, FeatureSettings(extractor="rootsift"))


def test_a_map_of_another_model_of_that_name_is_refused(bird, tmp_path):
    made_up.write_cells(tmp_path, made_up.info("bird"), seed=1)
    with pytest.raises(MapError, match=r"built with 'bird' \(.*\), the localizer uses 'bird' \("):
        extractor_for(bird, FeatureSettings())


def test_a_map_of_a_model_that_is_not_here_is_refused_with_those_that_are(bird, tmp_path):
    (tmp_path / "bird.onnx").unlink()
    with pytest.raises(MapError, match=r"with 'bird' .* not here \(there are: orb, rootsift\)"):
        extractor_for(bird, FeatureSettings())


def test_a_map_is_built_with_a_model_by_name_on_several_threads(bird):
    frames = frames_of_noise(5)
    settings = MappingSettings(features="bird", max_features=50)
    found = images.extract(frames, CAMERA, settings, Threads(2), 5)
    alone = extractors.create("bird", 50)
    for frame, features in zip(frames, found.features, strict=True):
        assert features.descriptors.shape[1] == 16 and len(features) > 10
        assert np.array_equal(features.keypoints_px, alone.extract(frame.image).keypoints_px)


def test_ratio_and_pairs_are_rootsifts_and_other_features_have_their_own(bird, monkeypatch):
    ratios, similar = [], []
    choose = verification.choice.choose_pairs

    def chosen(descriptors, settings, *others):
        similar.append(settings.similar)
        return choose(descriptors, settings, *others)

    def matches(first, second, ratio):
        ratios.append(ratio)
        return np.empty((0, 2), np.int32)

    monkeypatch.setattr(verification, "mutual_matches", matches)
    monkeypatch.setattr(verification.choice, "choose_pairs", chosen)
    for name in ("rootsift", "bird"):
        settings = MappingSettings(features=name, max_features=50)
        found = images.extract(frames_of_noise(2), CAMERA, settings, Threads(1), 2)
        with pytest.raises(MapError, match="no two of the 2 images overlap"):
            verification.match(found, CAMERA, settings, Threads(1))
    wanted = settings.match
    assert ratios == [wanted.ratio, wanted.ratio_others] == [0.8, 0.95]
    assert similar == [wanted.similar, wanted.similar_others] == [8, 20]
