"""The networks that ship: what their files promise, and that they match better than RootSIFT.

The pictures are made by code and belong to no training run: another seed, warped and relit.
"""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from ground_station.feature_models import homographic, scale
from ground_station.feature_models.degrade import degrade
from ground_station.feature_models.images import procedural
from ground_station.features import catalogue, extractors, inspection

SEED = 90_210


@pytest.fixture(scope="module", params=["lark", "wren"])
def shipped(request):
    return catalogue.find(request.param)


@pytest.fixture(scope="module")
def pairs():
    rng = np.random.default_rng(SEED)
    made = []
    for index in range(8):
        picture = procedural(SEED, index, (240, 320))
        warped, matrix = homographic.warp(picture, rng)
        made.append((degrade(picture, rng), degrade(warped, rng), matrix))
    return made


def test_it_is_small_and_light_and_says_whose_it_is(shipped):
    assert shipped.path.parent == catalogue.SHIPPED
    assert len(shipped.data) <= 2_000_000
    assert inspection.macs(shipped.data, shipped.info, 640, 480) <= 1.5e9
    assert shipped.info.dimension == 64
    assert "pairs" in shipped.info.source and shipped.info.licence == "BSD-3-Clause"


def test_their_page_is_about_these_files():
    page = (catalogue.SHIPPED / "README.md").read_text()
    known = [catalogue.find(name).sha256 for name in ("lark", "wren")]
    assert re.findall(r"\b[0-9a-f]{64}\b", page) == known


def test_its_scale_is_what_is_measured(shipped):
    """A model whose file says another one has wrong limits, and nothing else would tell."""
    assert scale.measured(shipped.data, replace(shipped.info, distance_scale=1.0)) == pytest.approx(
        shipped.info.distance_scale, abs=0.02
    )


def test_more_of_its_matches_are_right_than_of_rootsifts(shipped, pairs):
    ours, other = (
        homographic.matching(extractors.create(name, 300), pairs)
        for name in (shipped.info.name, "rootsift")
    )
    assert ours.accuracy > other.accuracy + 0.05
    assert ours.correct > 1.2 * other.correct


def test_larks_points_are_nearer_to_where_they_should_be_than_wrens(pairs):
    def right(name: str) -> int:
        extractor = extractors.create(name, 300)
        found = [homographic.compared(extractor, *pair) for pair in pairs]
        return sum(int((each.apart_px < 0.5).sum()) for each in found)

    assert right("lark") > 1.2 * right("wren")


def test_larks_log_is_beside_it_and_ends_with_its_step():
    lines = (catalogue.SHIPPED / "lark.jsonl").read_text().splitlines()
    trained = int(re.search(r"(\d+) pairs", catalogue.find("lark").info.source)[1])
    assert trained == json.loads(lines[-1])["step"] * json.loads(lines[0])["recipe"]["batch"]
