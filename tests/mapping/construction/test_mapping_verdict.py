"""What a build says at its end is short, true to what it found, and names the next command."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hand_made import keyframes_of

from ground_station.geometry.camera import Camera
from ground_station.map.store import Landmarks, Map, MapInfo
from ground_station.mapping.construction.verdict import next_step, verdict

EVERY = [f"{k:04d}.jpg" for k in range(40)]


def map_of(names: list[str], **built: Any) -> Map:
    """A map of these images, with 50 landmarks and what a build has written."""
    landmarks = Landmarks(
        id=np.arange(50), position_m=np.zeros((50, 3)),
        covariance_m2=np.zeros((50, 3, 3), np.float32),
        descriptor=np.zeros((50, 8), np.float32), spread=np.zeros(50, np.float32),
        view_direction=np.zeros((50, 3), np.float32), view_cos=np.zeros(50, np.float32),
        distance_m=np.zeros((50, 2), np.float32), observations=np.full(50, 4, np.int32),
    )  # fmt: skip
    keyframes = replace(keyframes_of(np.tile(np.eye(4), (len(names), 1, 1)), 1), names=names)
    built = {"images": 40, "observations": 200, "reprojection_px": 0.4312} | built
    return Map(MapInfo("rootsift", "0" * 64, 8, Camera(), built=built), landmarks, keyframes)


def test_a_whole_map_needs_few_words() -> None:
    found = verdict(map_of(EVERY, noise_px=0.5))
    assert found.word == "whole" and found.missing == []
    assert found.lines == [
        "WHOLE: all 40 images stand in this map, in one piece",
        "exact: 50 landmarks fit 200 observations to 0.43 px; a key point's noise is 0.50 px",
        "scale: unknown until the map is registered; lengths in it are its own",
    ]


def test_images_left_out_are_named_with_the_reason_those_of_most_images_first() -> None:
    left = {"0003.jpg": "blurred"} | dict.fromkeys(EVERY[10:15], "no overlap")
    found = verdict(map_of([n for n in EVERY if n not in left], left_out=left))
    assert found.word == "incomplete" and found.missing == sorted(left)
    assert found.lines[:3] == [
        "INCOMPLETE: 34 of 40 images stand in this map, in one piece; 6 are left out",
        "left out: 0010.jpg to 0014.jpg (5): no overlap",
        "left out: 0003.jpg: blurred",
    ]


def test_parts_are_said_in_the_first_lines_with_their_images() -> None:
    parts = [EVERY[:20], EVERY[20:30], EVERY[35:]]
    left = dict.fromkeys(EVERY[20:], "no place")
    found = verdict(map_of(parts[0], parts=parts, left_out=left))
    assert found.word == "in parts" and found.missing == EVERY[20:]
    assert found.lines[0] == (
        "IN PARTS: 20 of 40 images stand in this map; 2 other parts of 10 and 5 images could not "
        "be joined to it"
    )
    assert found.lines[1:5] == [
        "part 1, this map: 0000.jpg to 0019.jpg (20)",
        "part 2, apart: 0020.jpg to 0029.jpg (10)",
        "part 3, apart: 0035.jpg to 0039.jpg (5)",
        "left out: 0030.jpg to 0034.jpg (5): no place",  # what is in a part is not left out
    ]


def test_models_that_stayed_apart_are_parts_also_where_their_images_are_not_told() -> None:
    found = verdict(map_of(EVERY[:30], model_sizes=[30, 8]))
    assert found.word == "in parts" and "another part of 8 images" in found.lines[0]


def test_a_doubt_goes_before_all_else() -> None:
    doubts = ["0003.jpg to 0009.jpg may stand at the other of two like walls"]
    found = verdict(map_of(EVERY, doubts=doubts))
    assert found.word == "doubtful" and found.lines[0].startswith("DOUBTFUL: 40 of 40 images")
    assert found.lines[1] == f"doubt: {doubts[0]}"


def test_many_of_a_kind_are_a_few_lines() -> None:
    left = {name: f"reason {k % 13}" for k, name in enumerate(EVERY[5:])}
    doubts = [f"doubt {k}" for k in range(30)]
    parts = [EVERY[:5], *([name] for name in EVERY[5:15])]
    lines = verdict(map_of(EVERY[:5], left_out=left, doubts=doubts, parts=parts)).lines
    assert len(lines) <= 16 and max(map(len, lines)) < 200
    assert "… 27 more doubts: blimp map info has all" in lines


def test_the_lens_is_said_where_something_was_found() -> None:
    lines = verdict(map_of(EVERY, lens={"said": "f 501 ± 2 px"})).lines
    assert "lens: f 501 ± 2 px" in lines


@pytest.mark.parametrize(
    ("built", "command"),
    [
        ({}, "blimp map register 'maps/a b' --page "),
        ({"doubts": ["d"]}, "blimp map view 'maps/a b' --out 'a b.html' --open "),
        ({"model_sizes": [40, 9]}, "blimp map view "),
    ],
)
def test_the_next_command_follows_from_the_verdict(built: dict[str, Any], command: str) -> None:
    map_ = map_of(EVERY, **built)
    assert next_step(verdict(map_), map_, "maps/a b").startswith(command)


def test_a_map_in_parts_of_rootsift_names_the_features_that_join_more() -> None:
    map_ = map_of(EVERY[:20], parts=[EVERY[:20], EVERY[20:]])
    for features, named in (("rootsift", True), ("lark", False)):
        map_.info.features = features
        assert ("--features lark" in next_step(verdict(map_), map_, "maps/a")) == named


def test_a_registered_map_is_ready_to_localize() -> None:
    map_ = map_of(EVERY)
    map_.info.frame, map_.info.units = "world", "m"
    found = verdict(map_)
    assert found.lines[-1] == "scale: metres, in the world's frame"
    assert next_step(found, map_, "maps/a").startswith("blimp localize ")
