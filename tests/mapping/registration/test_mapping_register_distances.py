"""Known distances give a map its scale, alone or beside other measurements."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from ground_station.errors import MapError
from ground_station.geometry import poses
from ground_station.geometry.trajectory import Trajectory
from ground_station.map import store
from ground_station.mapping.registration.distances import COLUMNS, measure_scale, read_distances
from ground_station.mapping.registration.register import register_map

ENDS = [
    ([7.0, 3.2, 0.8], [7.6, 5.6, 1.6]),
    ([6.2, 4.0, 1.9], [7.8, 4.4, 0.7]),
    ([6.5, 5.8, 1.0], [7.9, 3.4, 1.4]),
]


def lines_of(scene, wrong=None, told=None, noise_px=0.2):
    """DISTANCES.csv lines; the one with the number `wrong` is told a third too long."""
    rng = np.random.default_rng(2)
    lines = [",".join(COLUMNS)]
    for d, pair in enumerate(ENDS):
        length = float(np.linalg.norm(np.subtract(*pair))) * (4 / 3 if d == wrong else 1)
        for end, point in zip("ab", pair, strict=True):
            for k in (0, 5, 10, 15):
                local = poses.transform(poses.inverse(scene.wTc[k]), np.array([point]))
                u, v = scene.camera.project(local)[0] + noise_px * rng.normal(size=2)
                lines.append(f"d{d},{end},frame-{k:06d},{u:.4f},{v:.4f},{told or length:.5f}")
    return lines


def read(tmp_path, lines):
    path = tmp_path / "DISTANCES.csv"
    path.write_text("\n".join(lines) + "\n")
    return read_distances(path)


def test_distances_alone_make_metres_and_no_world(built, target, tmp_path):
    moved, found = register_map(target, distances=read(tmp_path, lines_of(built.scene)))
    info = store.load_info(target)
    assert (info.frame, info.units, info.registered) == ("sfm", "m", False)
    steps, true_steps = (
        np.linalg.norm(np.diff(wTc[:, :3, 3], axis=0), axis=1)
        for wTc in (moved.keyframes.wTc, built.scene.wTc)
    )
    assert steps.sum() == pytest.approx(true_steps.sum(), rel=0.01)
    assert info.registration["method"] == "distances" and info.registration["distances"] == 3
    assert 0.05 < info.registration["scale_sigma_percent"] < 2
    assert "centre_90_percent_m" not in info.registration
    assert any("scale only" in note for note in found.notes)


def test_a_wrong_distance_is_found_and_named(built, tmp_path):
    found = measure_scale(built.map, read(tmp_path, lines_of(built.scene, wrong=1)))
    good = measure_scale(built.map, read(tmp_path, lines_of(built.scene)))
    assert found.count == 2 and found.scale == pytest.approx(good.scale, rel=0.01)
    assert any("'d1' left out: +" in note for note in found.notes)


def test_two_distances_that_contradict_each_other_are_said_and_believed_less(built, tmp_path):
    lines = lines_of(built.scene, wrong=1)
    two = [line for line in lines if not line.startswith("d2,")]
    found = measure_scale(built.map, read(tmp_path, two))
    alike = measure_scale(
        built.map, read(tmp_path, [x for x in lines_of(built.scene) if not x.startswith("d2,")])
    )
    assert any("contradict each other" in note for note in found.notes)
    assert found.sigma > 3 * alike.sigma


def test_distances_sharpen_the_scale_of_another_registration(built, target, tmp_path):
    rng = np.random.default_rng(3)
    truth = built.scene.wTc.copy()
    truth[:, :3, 3] += 0.05 * rng.normal(size=(len(truth), 3))
    trajectory = Trajectory.from_poses(built.map.keyframes.time_ns, truth)
    other = target.with_name("other")
    shutil.copytree(target, other)
    distances = read(tmp_path, lines_of(built.scene))
    _, plain = register_map(other, trajectory=trajectory)
    moved, both = register_map(target, trajectory=trajectory, distances=distances)
    assert both.report["scale_sigma_percent"] < 0.5 * plain.report["scale_sigma_percent"]
    true_scale = measure_scale(built.map, distances).scale
    assert abs(both.fit.scale / true_scale - 1) < abs(plain.fit.scale / true_scale - 1)
    assert moved.info.registered and both.report["distances"] == 3
    # What stands where the positions are known best stays there.
    centre = both.uncertainty.centre[None]
    back = plain.fit.rotation.T @ (centre[0] - plain.fit.translation) / plain.fit.scale
    assert np.linalg.norm(both.fit.apply(back[None]) - centre) < 1e-6


def test_distances_that_do_not_fit_the_rest_are_said(built, target, tmp_path):
    trajectory = Trajectory.from_poses(built.map.keyframes.time_ns, built.scene.wTc)
    lines = [
        ",".join([*line.split(",")[:5], str(1.2 * float(line.split(",")[5]))])
        if line.startswith("d") and line[1].isdigit()
        else line
        for line in lines_of(built.scene)
    ]
    _, found = register_map(target, trajectory=trajectory, distances=read(tmp_path, lines))
    assert any("the distances say a scale +18" in note for note in found.notes)


def test_distances_alone_do_not_move_a_map_that_is_in_the_world(built, target, tmp_path):
    trajectory = Trajectory.from_poses(built.map.keyframes.time_ns, built.scene.wTc)
    register_map(target, trajectory=trajectory)
    with pytest.raises(MapError, match="in the world already"):
        register_map(target, distances=read(tmp_path, lines_of(built.scene)))
    assert store.load_info(target).registered


HEAD = "distance,end,image,u_px,v_px,length_m"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "'distance' is missing"),
        (HEAD, "holds no distances"),
        (f"{HEAD}\nd,c,i,1,2,3", "observation 1: end is 'c'; allowed: a, b"),
        (f"{HEAD}\nd,a,i,1,2,nan", "observation 1: length_m is nan"),
        (f"{HEAD}\nd,a,i,1,2,0", "length_m is 0; allowed: 0.01 to 10000"),
        (f"{HEAD}\nd,a,i,1,2,-3", "length_m is -3; allowed"),
        (f"{HEAD}\nd,a,i,1,2", "observation 1: numbers are needed"),
        (f"{HEAD}\nd,a,i,1,2,3\nd,b,i,1,2,4", "observation 2: the distance 'd' was 3 m before"),
        (f"{HEAD}\nd,a,i,1,2,3\nd,a,i,5,2,3", "observation 2: end a of 'd' was seen in 'i' before"),
        (f"{HEAD},sigma_m\nd,a,i,1,2,3,5", "sigma_m is 5; allowed"),
        (f"{HEAD},sigma_m\nd,a,i,1,2,3,x", "numbers are needed in sigma_m"),
    ],
)
def test_a_distances_file_that_is_wrong_is_refused_by_line(tmp_path, text, words):
    with pytest.raises(MapError, match=words) as caught:
        read(tmp_path, [text])
    assert "\n" not in str(caught.value)


def test_distances_that_the_map_does_not_show_are_refused(built, target, tmp_path):
    with pytest.raises(MapError, match="none of the distances can be measured in the map"):
        register_map(target, distances=read(tmp_path, [HEAD, "d,a,i,1,2,3", "d,b,i,1,2,3"]))
