"""The network that ships: what its file promises, and that it matches better than RootSIFT.

The pictures are made by code and belong to no training run: another seed, warped and relit.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ground_station.feature_models import homographic, scale
from ground_station.feature_models.degrade import degrade
from ground_station.feature_models.images import procedural
from ground_station.features import catalogue, extractors, inspection

SEED = 90_210


@pytest.fixture(scope="module")
def wren():
    return catalogue.find("wren")


@pytest.fixture(scope="module")
def pairs():
    rng = np.random.default_rng(SEED)
    made = []
    for index in range(8):
        picture = procedural(SEED, index, (240, 320))
        warped, matrix = homographic.warp(picture, rng)
        made.append((degrade(picture, rng), degrade(warped, rng), matrix))
    return made


def test_it_is_small_and_light_and_says_whose_it_is(wren):
    assert wren.path.parent == catalogue.SHIPPED
    assert len(wren.data) <= 2_000_000
    assert inspection.macs(wren.data, wren.info, 640, 480) <= 1.5e9
    assert 64 <= wren.info.dimension <= 128
    assert "ALIKE" in wren.info.source and wren.info.licence == "BSD-3-Clause"


def test_its_page_is_about_this_file(wren):
    page = (catalogue.SHIPPED / "README.md").read_text()
    assert re.findall(r"\b[0-9a-f]{64}\b", page) == [wren.sha256]


def test_its_scale_is_what_is_measured(wren):
    """A model whose file says another one has wrong limits, and nothing else would tell."""
    assert scale.measured(wren.data, replace(wren.info, distance_scale=1.0)) == pytest.approx(
        wren.info.distance_scale, abs=0.02
    )


def test_more_of_its_matches_are_right_than_of_rootsifts(pairs):
    ours, other = (
        homographic.matching(extractors.create(name, 300), pairs) for name in ("wren", "rootsift")
    )
    assert ours.accuracy > other.accuracy + 0.05
    assert ours.correct > 1.2 * other.correct


def test_its_logs_are_beside_it_and_end_with_its_step(wren):
    logs = sorted(Path(catalogue.SHIPPED).glob("*.jsonl"))
    assert logs
    last = max(int(step) for log in logs for step in re.findall(r'"step": (\d+)', log.read_text()))
    trained = int(re.search(r"(\d+) pairs", wren.info.source)[1])
    assert trained == last * 8
