"""The measures of features on data whose answers are known."""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from ground_station.bench.features import command, homographies
from ground_station.bench.features.homographies import Pair, Score, score
from ground_station.errors import InputError
from ground_station.feature_models.homographic import Found
from ground_station.features import extractors
from ground_station.features.extractor import Features

SHIFT = np.array([[1.0, 0, 10], [0, 1, 0], [0, 0, 1]])
WARP = np.array([[0.95, 0.05, 12.0], [-0.04, 1.02, 8.0], [8e-5, -5e-5, 1.0]])


def features(points, descriptors) -> Features:
    vectors = np.asarray(descriptors, np.float32)
    vectors = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return Features(np.asarray(points, np.float32), np.ones(len(points), np.float32), vectors)


def picture(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 256, (60, 80), dtype=np.uint8)
    return cv2.GaussianBlur(cv2.resize(image, (640, 480), interpolation=cv2.INTER_CUBIC), None, 2)


def flat(homography=SHIFT) -> Pair:
    empty = np.zeros((100, 100), np.uint8)
    return Pair("wall 1-2", empty, empty, homography)


def test_counts_are_those_made_by_hand():
    eye = np.eye(6)
    first = features([[10, 10], [50, 50], [95, 20], [30, 80], [60, 20]], eye[:5])
    # Found again: the first exactly, the second 2.9 px off; the fourth's match is 40 px off; the
    # fifth has no match that is mutual. The third, at x = 105 there, is out of view.
    second = features(
        [[20, 10], [60, 52.9], [40, 40], [3, 90]], [eye[0], eye[1], eye[3], eye[5] + 0.1 * eye[2]]
    )
    made = score(first, second, flat())
    told, found = made.document(), made.found
    assert told["keypoints"] == (5, 4)
    # Of the first 4 are in view (one is not), of the second 3 (x = 3 would be at -7).
    assert told["seen"] == 4 + 3
    assert told["repeated"] == 2 + 2
    assert found.repeatability == pytest.approx(4 / 7)
    assert (told["matches"], told["correct"]) == (4, 2)
    assert found.accuracy == 0.5


def test_a_match_is_correct_up_to_three_pixels():
    eye = np.eye(4)
    for off, expected in ((3.0, 1), (3.01, 0)):
        first, second = features([[10, 10]] * 2, eye[:2]), features([[20 + off, 10]] * 2, eye[:2])
        assert score(first, second, flat()).found.correct == 2 * expected


def test_nothing_found_scores_nothing():
    none = Features(np.empty((0, 2), np.float32), np.empty(0, np.float32), np.empty((0, 4)))
    some = features([[10, 10]], [[1, 0, 0, 0]])
    for first, second in ((none, none), (none, some), (some, none)):
        made = score(first, second, flat())
        assert (made.found.repeatability, made.found.accuracy) == (0, 0)
        assert made.corners_px == math.inf


@pytest.mark.parametrize("name", ["rootsift", "orb"])
def test_a_picture_and_its_warp_are_matched_and_give_the_homography(name):
    first = picture()
    second = cv2.warpPerspective(first, WARP, (640, 480), flags=cv2.INTER_CUBIC)
    (found,) = homographies.measure(
        extractors.create(name, 800), [Pair("wall 1-2", first, second, WARP)]
    )
    assert found.found.repeatability > 0.7 and found.found.accuracy > 0.8
    assert found.corners_px < 1


def test_a_wrong_truth_is_told_by_all_measures():
    first = picture()
    second = cv2.warpPerspective(first, WARP, (640, 480), flags=cv2.INTER_CUBIC)
    wrong = WARP.copy()
    wrong[0, 2] += 12
    (found,) = homographies.measure(
        extractors.create("rootsift", 800), [Pair("wall 1-2", first, second, wrong)]
    )
    assert found.found.accuracy < 0.05
    assert found.corners_px == pytest.approx(12, rel=0.2)


def test_means_are_over_pairs_and_by_scene():
    def found(repeated: int, correct: int) -> Found:
        """Of ten each."""
        order = np.arange(10)
        nearest_px, apart_px = (np.where(order < n, 0.0, 9.0) for n in (repeated, correct))
        return Found(nearest_px, np.zeros((10, 2), np.int32), apart_px)

    scores = [
        Score("a 1-2", (10, 20), found(5, 9), 0.5),
        Score("a 1-3", (10, 20), found(10, 7), 4.0),
        Score("b 1-2", (30, 30), found(0, 2), math.inf),
    ]
    told = homographies.summary(scores)
    assert told["repeatability"] == pytest.approx(0.5)
    assert told["accuracy"] == pytest.approx(0.6)
    assert told["scenes"] == {"a": pytest.approx(0.8), "b": pytest.approx(0.2)}
    assert told["homography"] == {"1": pytest.approx(1 / 3), "3": pytest.approx(1 / 3),
                                   "5": pytest.approx(2 / 3)}  # fmt: skip
    assert told["keypoints"] == pytest.approx((15 + 15 + 30) / 3)


def write_pair(folder: Path) -> None:
    folder.mkdir(parents=True)
    first = picture()
    cv2.imwrite(str(folder / "wall1.png"), first)
    second = cv2.warpPerspective(first, WARP, (640, 480), flags=cv2.INTER_CUBIC)
    cv2.imwrite(str(folder / "wall2.png"), second)
    np.savetxt(folder / "wall.H1to2p", WARP)


def test_pairs_are_read_in_the_oxford_layout(tmp_path):
    write_pair(tmp_path / "data")
    (pair,) = homographies.read_pairs(tmp_path / "data")
    assert pair.name == "wall 1-2" and pair.first.shape == (480, 640)
    assert np.allclose(pair.homography, WARP)


def test_a_folder_without_pairs_and_broken_files_are_refused_by_name(tmp_path):
    with pytest.raises(InputError, match="none: there are no pairs"):
        homographies.read_pairs(tmp_path / "none")
    folder = tmp_path / "data"
    write_pair(folder)
    for text in ("1 2 3", "a b c d e f g h i", "0 0 0 0 0 0 0 0 0", "nan 0 0 0 1 0 0 0 1"):
        (folder / "wall.H1to2p").write_text(text)
        with pytest.raises(InputError, match=r"wall\.H1to2p: "):
            homographies.read_pairs(folder)
    (folder / "wall2.png").unlink()
    with pytest.raises(InputError, match=r"wall2\.png"):
        homographies.read_pairs(folder)


def test_the_table_has_a_column_where_there_is_a_figure_and_a_dash_where_not():
    rows = {
        "orb": {"name": "orb", "dimension": 256, "time": {"ms": 7.04, "ratio": 0.05}},
        "rootsift": {
            "name": "rootsift",
            "dimension": 128,
            "time": {"ms": 140.0, "ratio": 1.0},
            "homographies": {
                "repeatability": 0.554, "accuracy": 0.771, "scenes": {"leuven": 0.851},
                "homography": {"1": 0.8, "3": 1.0, "5": 1.0},
            },
        },
    }  # fmt: skip
    head, first, second = command.table(rows)
    assert "graf" not in head and "leuven" in head
    assert first.split() == ["orb", "256", "-", "-", "-", "-", "7.0", "0.05"]
    assert "55.4 %" in second and "85.1 %" in second and "80, 100, 100 %" in second
    assert len({len(line) for line in (head, first, second)}) == 1


def test_times_are_shares_of_rootsifts_in_the_same_run():
    made = {name: extractors.create(name, 300) for name in ("rootsift", "orb")}
    found = command.times(made, command.picture(0), 3)
    assert found["rootsift"]["ratio"] == 1
    assert found["orb"]["ratio"] == pytest.approx(found["orb"]["ms"] / found["rootsift"]["ms"])
    alone = command.times({"orb": made["orb"]}, command.picture(0), 3)
    assert alone["orb"]["ratio"] is None and alone["orb"]["ms"] > 0
    assert json.dumps(found)
