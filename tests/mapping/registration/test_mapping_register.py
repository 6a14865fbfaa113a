"""Registration finds the similarity to the world, says how well, and refuses what is degenerate."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hand_made import model_of

from ground_station.errors import MapError
from ground_station.geometry import poses
from ground_station.geometry.trajectory import Trajectory
from ground_station.map import colmap, landmarks, store
from ground_station.mapping.registration import observations, register

pycolmap = colmap.pycolmap


def make_pairs(scene, chosen, rng, noise_px=0.3):
    """PAIRS.csv lines of points (P, 3) that are seen by at least two images."""
    lines = [",".join(observations.COLUMNS)]
    for p, point in enumerate(chosen):
        for k, T in enumerate(scene.wTc):
            local = poses.transform(poses.inverse(T), point[None])
            pixel = scene.camera.project(local)[0] + noise_px * rng.normal(size=2)
            if np.all(pixel > 0) and np.all(pixel < [639, 479]):
                row = [f"{v:.6f}" for v in (*pixel, *point)]
                lines.append(f"p{p},frame-{k:06d},{','.join(row)}")
    return lines


@pytest.fixture
def world_points():
    """Twelve places on the far walls, not on one line nor in one plane."""
    rng = np.random.default_rng(8)
    points = rng.uniform([6.0, 3.0, 0.6], [7.9, 5.9, 2.0], (12, 3))
    return points


@pytest.fixture
def lines(built, world_points) -> list[str]:
    """Of these places, all as they should be."""
    return make_pairs(built.scene, world_points, np.random.default_rng(1))


def _pairs(tmp_path: Path, lines: list[str]) -> observations.PointObservations:
    path = tmp_path / "PAIRS.csv"
    path.write_text("\n".join(lines) + "\n")
    return observations.read_pairs(path)


def _camera_errors(map_: store.Map, scene) -> np.ndarray:
    return np.linalg.norm(map_.keyframes.wTc[:, :3, 3] - scene.wTc[:, :3, 3], axis=1)


def test_observations_of_known_points_put_the_map_into_the_world(built, target, tmp_path, lines):
    moved, found = register.register_map(
        target, observations=_pairs(tmp_path, lines), source="P.csv"
    )
    assert _camera_errors(moved, built.scene).max() < 0.03
    turned = moved.keyframes.wTc[:, :3, :3] @ np.swapaxes(built.scene.wTc[:, :3, :3], 1, 2)
    assert np.degrees(poses.rotation_angle(turned)).max() < 0.3
    report = found.report
    assert report["points"] == 12 and report["residual_rms_m"] < 0.03
    assert report["held_out_rms_m"] >= report["residual_rms_m"]
    assert 0.1 < report["reprojection_rms_px"] < 1.0
    assert 0 < report["scale_sigma_percent"] < 2


def test_everything_in_the_folder_is_in_world_coordinates(target, tmp_path, lines):
    register.register_map(target, observations=_pairs(tmp_path, lines), source="P.csv")
    loaded = store.load(target)
    model = pycolmap.Reconstruction(target / "sparse")
    lm, kf = loaded.landmarks, loaded.keyframes
    assert loaded.info.registered and loaded.info.units == "m"
    assert loaded.info.registration["source"] == "P.csv"
    assert np.allclose([model.points3D[i].xyz for i in lm.id.tolist()], lm.position_m, atol=1e-9)
    by_name = {image.name: image for image in model.images.values()}
    centres = np.array([by_name[name].projection_center() for name in kf.names])
    assert np.allclose(centres, kf.wTc[:, :3, 3], atol=1e-9)
    arrays = colmap.to_arrays(model)
    again = landmarks.make_landmarks(
        arrays, np.ones((len(arrays.point), loaded.info.dimension), np.float32)
    )
    assert np.allclose(again.covariance_m2, lm.covariance_m2, rtol=1e-3, atol=1e-9)
    assert np.allclose(again.distance_m, lm.distance_m, rtol=1e-5)
    assert np.allclose(again.view_direction, lm.view_direction, atol=1e-5)
    assert np.abs(landmarks.residuals_px(arrays)).max() < 4


def test_registering_again_changes_nothing_but_the_report(built, target, tmp_path, lines):
    first, _ = register.register_map(target, observations=_pairs(tmp_path, lines))
    second, found = register.register_map(target, observations=_pairs(tmp_path, lines))
    assert found.report["scale"] == pytest.approx(1, abs=1e-6)
    assert np.allclose(first.keyframes.wTc, second.keyframes.wTc, atol=1e-5)
    assert np.array_equal(
        store.load(target).landmarks.descriptor, store.load(built.folder).landmarks.descriptor
    )


def test_wrong_points_are_found_and_named(built, target, tmp_path, lines):
    lines = [  # points 3 and 7 were measured elsewhere
        ",".join([*line.split(",")[:4], "1.0", "2.0", "9.0"])
        if line.startswith("p3,")
        else ",".join([*line.split(",")[:4], "5.0", "-4.0", "0.5"])
        if line.startswith("p7,")
        else line
        for line in lines
    ]
    moved, found = register.register_map(target, observations=_pairs(tmp_path, lines))
    assert _camera_errors(moved, built.scene).max() < 0.04
    assert found.report["points"] == 10
    assert all(any(f"'{name}' left out" in note for note in found.notes) for name in ("p3", "p7"))


def test_a_trajectory_puts_the_map_into_the_world(built, target):
    scene, kf = built.scene, built.map.keyframes
    truth = Trajectory.from_poses(kf.time_ns + 3_000_000, scene.wTc)
    moved, found = register.register_map(target, trajectory=truth, source="truth.txt")
    assert _camera_errors(moved, scene).max() < 0.02
    assert found.report["method"] == "trajectory" and found.report["points"] == len(kf)
    report = store.load(target).info.registration
    assert report["orientations"] == len(kf) and report["orientation_offset_deg"] < 1
    assert 0 < report["residual_rms_deg"] <= report["residual_max_deg"] < 0.3
    assert report["residual_rms_m"] <= report["residual_max_m"] < 0.03
    late = Trajectory.from_poses(kf.time_ns + 30_000_000, scene.wTc)
    with pytest.raises(MapError, match=r"0 of 16 keyframes have a pose within 0.01 s"):
        register.register_map(target, trajectory=late)


def test_a_registered_map_is_taken_by_a_trajectory_from_any_frame_to_the_same_world(built, target):
    scene, kf = built.scene, built.map.keyframes
    truth = Trajectory.from_poses(kf.time_ns, scene.wTc)
    first, _ = register.register_map(target, trajectory=truth)
    turn = poses.exp(np.array([0.9, -1.4, 2.0, 30.0, -20.0, 5.0]))
    elsewhere = Trajectory.from_poses(kf.time_ns, turn @ scene.wTc)
    moved, _ = register.register_map(target, trajectory=elsewhere)
    assert np.allclose(moved.keyframes.wTc, turn @ first.keyframes.wTc, atol=1e-6)
    back, found = register.register_map(target, trajectory=truth)
    assert np.allclose(back.keyframes.wTc, first.keyframes.wTc, atol=1e-6)
    assert found.report["scale"] == pytest.approx(1, abs=1e-6)
    assert np.allclose(store.load(target).landmarks.position_m, first.landmarks.position_m)


@pytest.mark.parametrize(
    ("points", "words"),
    [
        ([[7.0, 4.0, 1.0], [7.5, 5.0, 1.5]], "2 of 2 points could be triangulated; at least 3"),
        ([[6.0 + 0.4 * k, 3.5 + 0.4 * k, 1.0] for k in range(5)], "on one line"),
    ],
)
def test_too_few_points_or_points_on_a_line_are_refused_and_the_map_stays(
    built, target, tmp_path, points, words
):
    lines = make_pairs(built.scene, np.array(points), np.random.default_rng(1))
    with pytest.raises(MapError, match=words) as caught:
        register.register_map(target, observations=_pairs(tmp_path, lines))
    assert "\n" not in str(caught.value)
    assert not store.load(target).info.registered
    assert [p.name for p in tmp_path.iterdir() if p.suffix == ".part"] == []


def test_points_in_images_that_the_map_lacks_are_left_out_with_a_note(target, tmp_path, lines):
    lines = [line.replace("frame-", "other-") if line.startswith("p0,") else line for line in lines]
    _, found = register.register_map(target, observations=_pairs(tmp_path, lines))
    assert found.report["points"] == 11
    assert any("'p0' left out: 0 of its" in note for note in found.notes)


def test_an_image_is_known_without_its_suffix_and_folder(target, tmp_path, lines):
    lines = [line.replace(",frame-", ",clicks/frame-") for line in lines]
    _, found = register.register_map(target, observations=_pairs(tmp_path, lines))
    assert found.report["points"] == 12


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "'point' is missing"),
        ("point,image,u_px,v_px,x_m,y_m\n", "'z_m' is missing"),
        ("point,image,u_px,v_px,x_m,y_m,z_m\n", "no observations"),
        ("point,image,u_px,v_px,x_m,y_m,z_m\na,b,1,2,3,4\n", "observation 1: numbers are needed"),
        ("point,image,u_px,v_px,x_m,y_m,z_m\na,b,1,2,3,4,x\n", "observation 1: numbers are needed"),
        ("point,image,u_px,v_px,x_m,y_m,z_m\na,b,1,2,3,4,nan\n", "observation 1: z_m is nan"),
        ("point,image,u_px,v_px,x_m,y_m,z_m\na,b,1,2,3,4,5\na,c,1,2,3,4,6\n", "'a' was at"),
        (
            "point,image,u_px,v_px,x_m,y_m,z_m\na,b,1,2,3,4,1e9\n",
            "observation 1: z_m is 1e\\+09; allowed",
        ),
        ("point,image,u_px,v_px,x_m,y_m,z_m\n,b,1,2,3,4,5\n", "column 'point' is empty"),
        ("z_m,image,u_px,v_px,x_m,y_m,point\n1,b,1,2,3,4\n", "column 'point' is empty"),
        ("point,image,u_px,v_px,x_m,y_m,z_m\na,b,1,2,3,4,5\na,b,1,2,3,4,5\n", "was seen in 'b'"),
        ("point,image,u_px,v_px,x_m,y_m,z_m\na,b,1,2,3,4,5\nc,b,1,2,3,4,5\n", "'a' and 'c' are at"),
    ],
)
def test_a_pairs_file_that_is_wrong_is_refused_by_line(tmp_path, text, words):
    path = tmp_path / "PAIRS.csv"
    path.write_text(text)
    with pytest.raises(MapError, match=words) as caught:
        observations.read_pairs(path)
    assert "\n" not in str(caught.value)


def test_triangulation_scatters_as_its_covariance_says(built):
    """Also the covariance of landmarks, which is the same matrix over the same kind of pixels."""
    scene, rng = built.scene, np.random.default_rng(5)
    camera = scene.camera
    # The middle of the image only: the noise is added in distorted pixels, where the lens of the
    # edge would scale it.
    point = np.array([7.4, 5.4, 1.2])
    T = scene.wTc[:6]
    exact = camera.project((poses.inverse(T) @ [*point, 1.0])[:, :3])
    found = []
    for _ in range(400):
        rays = camera.undistort(exact + rng.normal(size=exact.shape))
        found.append(observations.triangulate(T, rays, camera))
    scatter = np.cov(np.array(found).T)
    _, J = observations.reproject(point, T, camera.undistort(exact), camera)
    predicted = np.linalg.inv(np.einsum("ski,skj->ij", J, J))
    ratio = np.linalg.eigvals(np.linalg.solve(predicted, scatter)).real
    assert (ratio > 0.6).all() and (ratio < 1.6).all()
    model = model_of(
        camera, T, point[None], image=np.arange(6), point=np.zeros(6, np.int64),
        pixel_px=camera.undistort_to_pinhole(exact),
    )  # fmt: skip
    # There a pixel of the picture is one on the plane, to a few parts in a hundred.
    assert np.allclose(landmarks.covariances(model, 1.0)[0], predicted, rtol=0.1)
