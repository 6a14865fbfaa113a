"""`blimp bench map --study`: a folded map is seen as one, and whether its build said so."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ground_station import cli
from ground_station.bench.maps import study
from ground_station.bench.maps.study import is_silent_fold, judge, said
from ground_station.geometry import poses

NAMES = [f"frame-{k:06d}" for k in range(30)]
DEPTH_M = 4.0


def walk(seed: int = 0) -> np.ndarray:
    """True poses of a walk of 15 m."""
    rng = np.random.default_rng(seed)
    centres = np.column_stack(
        [np.linspace(0, 15, 30), rng.normal(0, 1, 30), rng.normal(0, 0.2, 30)]
    )
    return poses.pose(Rotation.random(30, rng=rng).as_matrix(), centres)


def in_map_units(wTc: np.ndarray, scale: float = 0.2) -> np.ndarray:
    """The same poses as a map has them: other origin, directions and unit."""
    R = Rotation.from_rotvec([0.3, -1.1, 0.4]).as_matrix()
    return poses.pose(R @ wTc[:, :3, :3], scale * wTc[:, :3, 3] @ R.T + [3.0, -1.0, 2.0])


def test_a_true_map_in_its_own_units_has_no_misplaced_image():
    judged = judge(NAMES, in_map_units(walk()), walk(), 0.2 * DEPTH_M)
    assert judged.misplaced == ()
    assert judged.max_m < 1e-6
    assert judged.bound_m == pytest.approx(0.05 * DEPTH_M)


def test_a_part_folded_over_is_named_and_does_not_bend_the_rest():
    folded = walk()
    folded[20:, 0, 3] -= 4.0  # ten images at the bay before
    judged = judge(NAMES, in_map_units(folded), walk(), 0.2 * DEPTH_M)
    assert judged.misplaced == tuple(NAMES[20:])
    assert judged.median_m < 1e-6 and judged.max_m == pytest.approx(4.0)


def test_a_turned_image_is_misplaced_and_a_shaken_one_is_not():
    turned = walk()
    turned[4, :3, :3] = turned[4, :3, :3] @ Rotation.from_euler("y", 8, degrees=True).as_matrix()
    turned[5, :3, :3] = turned[5, :3, :3] @ Rotation.from_euler("y", 3, degrees=True).as_matrix()
    turned[6, 2, 3] += 0.1
    assert judge(NAMES, in_map_units(turned), walk(), 0.2 * DEPTH_M).misplaced == (NAMES[4],)


def test_a_map_that_fits_nowhere_is_misplaced_as_a_whole():
    assert judge(NAMES, in_map_units(walk(7))[::-1], walk(), 1e-9).misplaced == tuple(NAMES)
    two = judge(NAMES[:2], walk()[:2], walk()[:2], DEPTH_M)
    assert two.misplaced == tuple(NAMES[:2]) and math.isnan(two.median_m)


def test_a_fold_is_silent_unless_the_build_doubts_or_keeps_parts_apart():
    folded = walk()
    folded[25:, 0, 3] -= 4.0
    judged = judge(NAMES, in_map_units(folded), walk(), 0.2 * DEPTH_M)
    assert is_silent_fold(judged.misplaced, said({}))
    assert is_silent_fold(judged.misplaced, said({"left_out": ["frame-000003"]}))
    assert not is_silent_fold(judged.misplaced, said({"doubts": ["two places look alike"]}))
    assert not is_silent_fold(judged.misplaced, said({"parts": [{"images": 4}]}))
    true = judge(NAMES, in_map_units(walk()), walk(), 0.2 * DEPTH_M)
    assert not is_silent_fold(true.misplaced, said({}))


def _row(features: str, registered: int, silent: bool) -> dict:
    figures = {"median_m": 0.01, "max_m": 0.5, "rmse_m": 0.1, "models": 1, "seconds": 12.0}
    told = {"doubts": 0, "parts": 0, "left_out": 2}
    misplaced = ("a",) if silent else ()
    ours = {"registered": registered, "misplaced": misplaced, "said": told, "silent_fold": silent}
    plain = {"registered": 90, "misplaced": ()}
    return {
        "set": "stills", "seed": 1, "features": features, "simulated": True, "images": 96,
        "ours": ours | figures, "plain": plain | figures,
    }  # fmt: skip


def test_the_table_has_plain_colmap_once_and_counts_what_must_be_none():
    lines = study.table([_row("rootsift", 92, False), _row("orb", 80, True)])
    assert sum("plain COLMAP   " in line for line in lines) == 1
    assert all("(simulated)" in line for line in lines[1:4])
    assert lines[3].split()[-2] == "YES" and lines[2].split()[-2] == "no"
    assert lines[-2].endswith("plain COLMAP: 1 of 2")
    assert lines[-1] == "folded maps that were not said: 1 of 2"


def test_a_build_that_failed_is_a_row_and_no_fold():
    failed = _row("orb", 0, False)
    failed["ours"] = {"failed": "images do not overlap", "registered": 0, "seconds": 3.0}
    lines = study.table([failed])
    assert lines[2].split()[-1] == "3"
    assert lines[-1].endswith("0 of 1")


def test_real_sets_that_are_missing_are_said_in_one_line_each(tmp_path, capsys):
    told = tmp_path / "study.json"
    words = ["bench", "map", "--study", "hallway", "kitchen", "--real", str(tmp_path / "none")]
    assert cli.main([*words, "--work", str(tmp_path), "--json", str(told)]) == 0
    assert capsys.readouterr().out.splitlines()[:-1] == [
        "hallway: left out, no folder 'hallway' in --real",
        "kitchen: left out, no folder 'redkitchen' in --real",
    ]
    assert json.loads(told.read_text())["rows"] == []
