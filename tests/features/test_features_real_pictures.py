"""Published weights on real pictures: what the extractors say is right where the truth is known."""

from __future__ import annotations

from pathlib import Path

import pytest

from ground_station.bench.features import homographies
from ground_station.feature_models import importer
from ground_station.features import extractors

SHARED = Path(__file__).parents[2] / "../shared"
WEIGHTS = SHARED / "models" / "alike-t.safetensors"
PICTURES = SHARED / "data" / "illumination"

needs_data = pytest.mark.skipif(
    not (WEIGHTS.is_file() and PICTURES.is_dir()),
    reason="../shared/models or ../shared/data/illumination is not there",
)


@needs_data
def test_alikes_weights_match_a_street_in_other_light(monkeypatch, tmp_path):
    """Nine in ten matches are right, and the homography is right to half a pixel."""
    monkeypatch.setenv("BLIMP_MODELS", str(tmp_path))
    monkeypatch.setattr(importer.scale, "measured", lambda data, info: 1.0)
    importer.import_weights(WEIGHTS)
    pairs = [p for p in homographies.read_pairs(PICTURES) if p.name == "leuven 1-2"]
    (found,) = homographies.measure(extractors.create("alike-t", 1000), pairs)
    assert found.found.accuracy > 0.88 and len(found.found.matches) > 500
    assert found.found.repeatability > 0.5
    assert found.corners_px < 1.5
