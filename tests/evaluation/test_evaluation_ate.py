"""Trajectory errors against evo and the values of public trajectories."""

from __future__ import annotations

import argparse
import contextlib
import json
import re
from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics, sync
from evo.core.trajectory import PoseTrajectory3D
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ground_station import cli
from ground_station.errors import InputError
from ground_station.evaluation import ate, command
from ground_station.geometry.trajectory import Trajectory, read_tum, write_tum
from pi_firmware.wire.recording import TRUTH_TOPIC, RecordingWriter

DATA = Path(__file__).parents[3] / "shared" / "data" / "trajectories"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="../shared/data is not there")


def path_of_n(n: int, seed: int, step_ns: int = 33_333_333) -> Trajectory:
    """A smooth walk with turning rotations."""
    rng = np.random.default_rng(seed)
    times = 1_700_000_000_000_000_000 + np.arange(n) * step_ns
    positions = np.cumsum(rng.normal(size=(n, 3)) * 0.1, axis=0)
    turns = Rotation.from_rotvec(np.cumsum(rng.normal(size=(n, 3)) * 0.05, axis=0))
    return Trajectory(times, positions, turns.as_quat())


def disturbed(truth: Trajectory, seed: int, similar: bool = True) -> Trajectory:
    """The truth in another frame and scale, with noise, a few poses missing and late times."""
    rng = np.random.default_rng(seed)
    keep = np.sort(rng.choice(len(truth), int(len(truth) * 0.8), replace=False))
    R = Rotation.random(random_state=seed) if similar else Rotation.identity()
    c, t = (rng.uniform(0.3, 3), rng.normal(size=3)) if similar else (1.0, np.zeros(3))
    n = len(keep)
    positions = c * R.apply(truth.position_m[keep]) + t + rng.normal(size=(n, 3)) * 0.02
    noise = Rotation.from_rotvec(rng.normal(size=(n, 3)) * 0.01)
    quaternions = (noise * R * Rotation.from_quat(truth.quaternion_xyzw[keep])).as_quat()
    jitter = rng.integers(-12_000_000, 12_000_000, n)
    return Trajectory(np.sort(truth.time_ns[keep] + jitter), positions, quaternions)


def of_evo(trajectory: Trajectory) -> PoseTrajectory3D:
    return PoseTrajectory3D(
        positions_xyz=trajectory.position_m.copy(),
        orientations_quat_wxyz=trajectory.quaternion_xyzw[:, [3, 0, 1, 2]].copy(),
        timestamps=np.array([t / 10**9 for t in trajectory.time_ns.tolist()]),
    )


def read_by_numpy(path: Path) -> PoseTrajectory3D:
    """TUM text as evo takes it apart (its own reader writes into the user's home)."""
    rows = np.loadtxt(path)
    return PoseTrajectory3D(
        positions_xyz=rows[:, 1:4], orientations_quat_wxyz=rows[:, [7, 4, 5, 6]],
        timestamps=rows[:, 0],
    )  # fmt: skip


def evos_ape(
    estimate: PoseTrajectory3D, truth: PoseTrajectory3D, align: str, max_diff_s: float
) -> dict[str, metrics.APE]:
    """What evo_ape computes of position and rotation (its `-r trans_part` and `-r angle_deg`)."""
    reference, other = sync.associate_trajectories(truth, estimate, max_diff=max_diff_s)
    if align != "none":
        other.align(reference, correct_scale=align == "sim3")
    found = {
        "position_m": metrics.APE(metrics.PoseRelation.translation_part),
        "rotation_deg": metrics.APE(metrics.PoseRelation.rotation_angle_deg),
    }
    for ape in found.values():
        ape.process_data((reference, other))
    return found


@needs_data
@pytest.mark.parametrize(
    ("estimate", "truth", "pairs", "expected"),
    [
        (
            "freiburg1_xyz-ORB_kf_mono", "freiburg1_xyz-groundtruth", 32,
            {"none": 2.025142, "se3": 0.024302, "sim3": 0.009755},
        ),
        ("fr2_desk_ORB_kf_mono", "fr2_desk_groundtruth", 118, {"sim3": 0.007729}),
        ("freiburg1_xyz-rgbdslam", "freiburg1_xyz-groundtruth", 785, {"se3": 0.013470}),
    ],
)  # fmt: skip
def test_public_trajectories_give_their_known_errors(
    estimate: str, truth: str, pairs: int, expected: dict[str, float]
) -> None:
    result = ate.evaluate(read_tum(DATA / f"{estimate}.txt"), read_tum(DATA / f"{truth}.txt"))
    assert result.pairs == pairs
    for name, value in expected.items():
        assert result.errors[name].rmse()["position_m"] == pytest.approx(value, abs=1e-5)
    if estimate.startswith("fr2"):
        assert result.errors["sim3"].alignment.scale == pytest.approx(2.228022, abs=1e-5)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31 - 1), st.integers(30, 90), st.sampled_from([0.002, 0.01, 0.02]))
def test_errors_are_evos(seed: int, n: int, max_diff_s: float) -> None:
    truth = path_of_n(n, seed)
    estimate = disturbed(truth, seed)
    assume(len(ate.associate(estimate.time_ns, truth.time_ns, max_diff_s)[0]))
    result = ate.evaluate(estimate, truth, max_diff_s)
    for align in ate.ALIGNMENTS:
        if align not in result.errors:
            assert result.pairs < 3
            continue
        evos = evos_ape(of_evo(estimate), of_evo(truth), align, max_diff_s)
        ours = result.errors[align]
        np.testing.assert_allclose(ours.position_m, evos["position_m"].error, atol=1e-6)
        np.testing.assert_allclose(ours.rotation_deg, evos["rotation_deg"].error, atol=1e-5)


milliseconds = st.lists(st.integers(0, 400), min_size=1, max_size=40, unique=True)


@settings(max_examples=300, deadline=None)
@given(milliseconds, milliseconds, st.sampled_from([0, 1, 5, 10, 20]))
def test_pairs_are_evos_also_at_ties_and_at_the_limit(
    estimate_ms: list[int], truth_ms: list[int], limit_ms: int
) -> None:
    base = 1_305_031_102
    a = np.array(sorted(estimate_ms)) * 1_000_000 + base * 10**9
    b = np.array(sorted(truth_ms)) * 1_000_000 + base * 10**9
    seconds = [
        np.array([float(f"{t // 10**9}.{t % 10**9:09d}") for t in s.tolist()]) for s in (a, b)
    ]
    # evo starts from the shorter one, from the second (the estimate, as evo_ape calls it) if equal.
    if len(a) <= len(b):
        i, j = sync.matching_time_indices(seconds[0], seconds[1], limit_ms / 1000)
    else:
        j, i = sync.matching_time_indices(seconds[1], seconds[0], limit_ms / 1000)
    ours = ate.associate(a, b, limit_ms / 1000)
    assert (ours[0].tolist(), ours[1].tolist()) == (i, j)


def test_zhangs_form_is_the_position_part_of_the_pose_error() -> None:
    truth = path_of_n(40, 5)
    estimate = disturbed(truth, 5, similar=False)
    pair = ate.synchronize(estimate, truth)
    errors = ate.errors(*pair)
    E = pair[1].wTc @ np.linalg.inv(pair[0].wTc)  # T = E T', so t - dR t' is E's translation
    np.testing.assert_allclose(errors.position_zhang_m, np.linalg.norm(E[:, :3, 3], axis=1))
    angles = np.degrees(Rotation.from_matrix(E[:, :3, :3]).magnitude())
    np.testing.assert_allclose(errors.rotation_deg, angles, atol=1e-9)


def test_a_rotation_error_far_from_the_origin_is_seen_by_zhangs_form_only() -> None:
    truth = Trajectory(
        np.array([1, 2]), np.array([[10.0, 0, 0]] * 2), np.array([[0, 0, 0, 1.0]] * 2)
    )
    turn = Rotation.from_euler("z", 0.6, degrees=True).as_quat()
    estimate = Trajectory(truth.time_ns, truth.position_m, np.array([turn] * 2))
    rmse = ate.evaluate(estimate, truth).errors["none"].rmse()
    assert rmse["position_m"] == 0 and rmse["rotation_deg"] == pytest.approx(0.6)
    assert rmse["position_zhang_m"] == pytest.approx(0.105, abs=0.001)


def test_statistics_are_what_they_are_called() -> None:
    s = ate.Statistics.of([3.0, 4.0, 0.0, 1.0])
    assert (s.mean, s.median, s.min, s.max) == (2.0, 2.0, 0.0, 4.0)
    assert s.rmse == pytest.approx(np.sqrt(26 / 4)) and s.std == pytest.approx(np.sqrt(2.5))


def test_few_pairs_have_errors_but_no_alignment() -> None:
    truth = path_of_n(2, 1)
    result = ate.evaluate(truth, truth)
    assert result.pairs == 2 and set(result.errors) == {"none"}
    assert result.ate()["se3"] is None and "2 points" in result.impossible["se3"]


def test_trajectories_that_never_meet_are_told_with_their_times() -> None:
    truth, later = path_of_n(5, 1), path_of_n(5, 1)
    later = Trajectory(later.time_ns + 10**12, later.position_m, later.quaternion_xyzw)
    with pytest.raises(InputError, match=r"^no estimated pose is within 0\.01 s .*1700001000\.000"):
        ate.evaluate(later, truth)
    empty = Trajectory.from_poses([], np.empty((0, 4, 4)))
    with pytest.raises(InputError, match="no poses"):
        ate.evaluate(empty, truth)
    for bad in (-1.0, float("nan")):
        with pytest.raises(InputError, match="max-diff-s"):
            ate.evaluate(truth, truth, bad)


def test_shares_count_both_limits_and_frames_without_an_estimate() -> None:
    truth = path_of_n(4, 1)
    errors = ate.errors(truth, truth)
    errors = ate.Errors(
        np.array([0.01, 0.03, 0.2, 0.01]), np.array([0.5, 1.5, 0.1, 9.0]),
        errors.position_zhang_m, errors.alignment,
    )  # fmt: skip
    assert [one["share"] for one in ate.shares(errors)] == [0.25, 0.5, 0.5]


def test_coverage_is_the_share_of_frames_with_a_pose() -> None:
    truth = path_of_n(10, 1)
    part = truth[2:7]
    assert ate.coverage(part, truth.time_ns) == 0.5
    assert ate.coverage(truth, truth.time_ns) == 1.0
    assert ate.coverage(part, truth.time_ns[:0]) == 0.0


# The command.


@pytest.fixture
def pair(tmp_path: Path) -> tuple[Path, Path]:
    truth = path_of_n(120, 3)
    write_tum(tmp_path / "truth.txt", truth)
    write_tum(tmp_path / "est.txt", disturbed(truth, 3))
    return tmp_path / "est.txt", tmp_path / "truth.txt"


@pytest.mark.parametrize("align", ate.ALIGNMENTS)
def test_blimp_evaluate_and_evo_ape_agree(
    pair: tuple[Path, Path], tmp_path: Path, align: str
) -> None:
    command.run(_arguments(*pair, "--align", align, "--json", tmp_path / "r.json"))
    ours = json.loads((tmp_path / "r.json").read_text())
    evos = evos_ape(*map(read_by_numpy, pair), align, 0.01)
    for key, ape in evos.items():
        stats = ape.get_all_statistics()
        assert ours["ate"][align][key] == pytest.approx(stats["rmse"], abs=1e-6)
        for name in ("mean", "median", "max", "min", "std"):
            assert ours["statistics"][align][key][name] == pytest.approx(stats[name], abs=1e-6)


def test_the_json_holds_what_scripts_rely_on(pair: tuple[Path, Path], tmp_path: Path) -> None:
    with contextlib.redirect_stdout(None):
        assert command.run(_arguments(*pair, "--json", tmp_path / "r.json")) == 0
    result = json.loads((tmp_path / "r.json").read_text())
    assert set(result["ate"]) == {"none", "se3", "sim3"}
    for one in result["ate"].values():
        assert set(one) == {"position_m", "rotation_deg", "position_zhang_m"}
    assert result["pairs"] <= result["estimate_poses"] == 96 < result["truth_poses"] == 120
    assert [s["share"] for s in result["shares"]] == sorted(s["share"] for s in result["shares"])
    assert 0 < result["coverage"] <= 0.8 and result["shares_align"] == "none"


def _arguments(*words: str | Path) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return parser.parse_args([str(word) for word in words])


def test_the_table_names_alignments_units_and_shares(
    pair: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    command.run(_arguments(*pair))
    printed = capsys.readouterr().out
    assert re.search(r"^none +\d", printed, re.M) and re.search(r"^sim3 +\d", printed, re.M)
    assert "position, m" in printed and "rotation, °" in printed
    assert "within 5 cm, 2°" in printed and "scale of sim3" in printed
    assert len({line.index("RMSE") for line in printed.splitlines() if "RMSE" in line}) == 1


def test_the_truth_may_be_a_recording_also_a_cut_one(
    pair: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = read_tum(pair[1])
    path = tmp_path / "flight.mcap"
    with RecordingWriter(path, chunk_bytes=1000) as writer:
        for t, p, q in zip(
            truth.time_ns.tolist(), truth.position_m, truth.quaternion_xyzw, strict=True
        ):
            writer.write_pose(t, p, q, topic=TRUTH_TOPIC)
    command.run(_arguments(*pair, "--align", "sim3"))
    from_text = capsys.readouterr().out.splitlines()[3:]
    command.run(_arguments(pair[0], path, "--align", "sim3"))
    assert capsys.readouterr().out.splitlines()[3:] == from_text
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    command.run(_arguments(pair[0], path, "--align", "sim3"))
    assert "cut (the file ends before its footer)" in capsys.readouterr().err


def test_what_is_wrong_is_one_line_and_status_2(
    pair: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    short = tmp_path / "short.txt"
    short.write_text("\n".join(pair[1].read_text().splitlines()[:3]) + "\n")
    (tmp_path / "nan.txt").write_text("1 nan 0 0 0 0 0 1\n")
    cases = [
        ([tmp_path / "missing.txt", pair[1]], "missing.txt"),
        ([tmp_path / "nan.txt", pair[1]], "nan.txt, line 1"),
        ([short, pair[1], "--align", "se3"], "short.txt: alignment: 2 points"),
        ([*pair, "--max-diff-s", "-1"], "--max-diff-s is -1.0"),
        ([*pair, "--json", tmp_path / "no" / "r.json"], "r.json"),
        ([*pair, "--plot", tmp_path / "no" / "p.png"], "p.png"),
    ]
    for arguments, says in cases:
        status = cli.main(["evaluate", *map(str, arguments)])
        errors = capsys.readouterr().err
        assert status == 2 and errors.count("\n") == 1 and says in errors, errors
