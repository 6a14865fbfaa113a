"""COLMAP's models, binary and text, are read exactly, and hostile ones refused in one line."""

from __future__ import annotations

import dataclasses
import shutil

import numpy as np
import pytest
from foreign_model import colmap_camera, foreign_model, image_name, write

from ground_station.errors import CameraError, MapError
from ground_station.geometry.camera import THESIS_CAMERA
from ground_station.map import colmap_files
from ground_station.map.colmap import pycolmap
from ground_station.mapping.sfm import foreign

KINDS = ("binary", "text")


@pytest.fixture(scope="module")
def scene(built):
    """Four images of sixty points."""
    whole = built.scene
    return dataclasses.replace(
        whole,
        points=whole.points[:60],
        wTc=whole.wTc[:4],
        seen=[seen[seen < 60] for seen in whole.seen[:4]],
        features=whole.features[:4],
    )


@pytest.fixture(scope="module", params=KINDS)
def written(request, scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("foreign") / request.param
    return write(foreign_model(scene), folder, request.param)


@pytest.fixture
def copy(written, tmp_path):
    return shutil.copytree(written, tmp_path / "model")


def test_poses_camera_and_names_are_colmaps(written, scene):
    model = foreign.read(written)
    assert model.names == [image_name(k) for k in range(4)]
    assert np.abs(model.wTc - scene.wTc).max() < 1e-9
    ours, theirs = model.camera.as_dict(), scene.camera.as_dict()
    for name in ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3"):
        assert ours[name] == pytest.approx(theirs[name], abs=1e-9)
    assert (model.camera.width_px, model.camera.height_px) == (640, 480)


def test_each_image_has_the_points_that_it_sees(written, scene):
    many = np.bincount(np.concatenate(scene.seen), minlength=60) > 1
    for points, seen in zip(foreign.read(written).points, scene.seen, strict=True):
        assert points.tolist() == (np.sort(seen[many[seen]]) + 1).tolist()


def camera_of(name, *values):
    return pycolmap.Camera(camera_id=1, model=name, width=640, height=480, params=values)


@pytest.mark.parametrize(
    "theirs",
    [
        camera_of("SIMPLE_PINHOLE", 500, 321, 243),
        camera_of("PINHOLE", 500, 510, 321, 243),
        camera_of("SIMPLE_RADIAL", 500, 321, 243, 0.1),
        camera_of("RADIAL", 500, 321, 243, 0.1, -0.2),
        camera_of("OPENCV", 500, 510, 321, 243, 0.1, -0.2, 0.003, -0.002),
        camera_of("OPENCV_FISHEYE", 500, 510, 321, 243, -0.02, 0.004, 0.003, -0.001),
        camera_of("FULL_OPENCV", 500, 510, 321, 243, 0.1, -0.2, 0.003, -0.002, 0.05, 0, 0, 0),
    ],
    ids=lambda theirs: theirs.model.name,
)
def test_every_lens_that_ours_holds_projects_as_colmaps(theirs):
    ours = foreign.camera_of(theirs)
    rays = np.random.default_rng(0).uniform([-0.5, -0.4, 1], [0.5, 0.4, 1], (50, 3))
    expected = np.array([theirs.img_from_cam(ray) for ray in rays])
    assert np.abs(ours.project(rays) + 0.5 - expected).max() < 1e-9


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("name", "params", "words"),
    [
        ("RADIAL_FISHEYE", [500, 320, 240, 0, 0], "camera 1: it has the model RADIAL_FISHE"),
        ("FOV", [500, 500, 320, 240, 0.9], "the model FOV; what can be taken over is SIMPLE_PINH"),
        ("FULL_OPENCV", [500, 500, 320, 240, *[0] * 5, 0.1, 0, 0], "FULL_OPENCV with k4 0.1, k5"),
        ("PINHOLE", [0.1, 500, 320, 240], "fx_px.*0.1"),
    ],
)
def test_other_lenses_are_refused_by_name(scene, tmp_path, kind, name, params, words):
    folder = write(foreign_model(scene, [camera_of(name, *params)]), tmp_path / "model", kind)
    with pytest.raises(MapError, match=words) as caught:
        foreign.read(folder)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", KINDS)
def test_images_of_two_cameras_are_refused_and_of_one_repeated_taken(scene, tmp_path, kind):
    same = [colmap_camera(THESIS_CAMERA, number=number) for number in (1, 2)]
    model = foreign.read(write(foreign_model(scene, same), tmp_path / "same", kind))
    assert model.camera.fx_px == THESIS_CAMERA.fx_px
    other = colmap_camera(dataclasses.replace(THESIS_CAMERA, fx_px=502.0), number=2)
    folder = write(foreign_model(scene, [same[0], other]), tmp_path / "other", kind)
    with pytest.raises(MapError, match=r"of 2 cameras \(1 and 2 differ\)"):
        foreign.read(folder)


def test_k3_comes_over(scene, tmp_path):
    camera = dataclasses.replace(THESIS_CAMERA, k3=0.07)
    folder = write(
        foreign_model(scene, [colmap_camera(camera, "FULL_OPENCV")]), tmp_path / "m", "text"
    )
    assert foreign.read(folder).camera.k3 == 0.07


def test_a_camera_beyond_ours_is_a_camera_error():
    with pytest.raises(CameraError, match="k6 1"):
        foreign.camera_of(camera_of("FULL_OPENCV", 500, 500, 320, 240, *[0] * 7, 1))


def test_a_folder_that_is_no_model_is_refused(tmp_path):
    with pytest.raises(MapError, match=r"no cameras\.bin or cameras.txt"):
        foreign.read(tmp_path)


def refused_or_whole(folder):
    """Whether it was refused, in one line."""
    try:
        model = foreign.read(folder)
    except MapError as error:
        assert "\n" not in str(error) and len(str(error)) < 1000
        return True
    assert np.isfinite(model.wTc).all()
    return False


@pytest.mark.parametrize("written", ["text"], indirect=True)
@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_a_text_file_that_is_cut_is_refused(copy, name):
    """Binary ones are cut in the tests of maps' own."""
    path = copy / f"{name}.txt"
    whole = path.read_bytes()
    for size in (0, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        assert refused_or_whole(copy)
    path.unlink()
    with pytest.raises(MapError, match="COLMAP model" if name != "cameras" else "no cameras.bin"):
        foreign.read(copy)


def test_bytes_that_were_changed_are_refused_or_read_but_end_nothing(copy, monkeypatch):
    monkeypatch.setattr(colmap_files, "_SECONDS", 1)
    rng = np.random.default_rng(3)
    paths = sorted(copy.iterdir())
    whole = {path: path.read_bytes() for path in paths}
    refused = 0
    for _ in range(12):
        path = paths[rng.integers(len(paths))]
        data = bytearray(whole[path])
        for _ in range(rng.integers(1, 4)):
            at = rng.integers(len(data))
            piece = rng.choice([b"\xff" * 8, b"\0" * 8, b"nan", b"-1", b"\n", b"9" * 30, b"1e999"])
            data[at : at + rng.integers(0, len(piece) + 1)] = piece
        path.write_bytes(bytes(data))
        refused += refused_or_whole(copy)
        path.write_bytes(whole[path])
    assert refused > 3


@pytest.mark.parametrize("name", ["../../etc/passwd.png", "/etc/a.png", "a\tb.png", ""])
def test_names_that_lead_elsewhere_are_refused(scene, tmp_path, name):
    model = foreign_model(scene)
    model.images[2].name = name
    folder = write(model, tmp_path / "model", "binary")
    with pytest.raises(MapError, match="has an image named"):
        foreign.read(folder)


def test_a_name_that_comes_twice_is_refused(scene, tmp_path):
    model = foreign_model(scene)
    model.images[2].name = image_name(0)
    with pytest.raises(MapError, match=r"two images named 'db/walk-00.png'"):
        foreign.read(write(model, tmp_path / "model", "binary"))


def test_a_name_with_a_space_comes_over_in_a_binary_model_and_is_said_of_a_text(scene, tmp_path):
    model = foreign_model(scene)
    model.images[2].name = "a walk.png"
    assert "a walk.png" in foreign.read(write(model, tmp_path / "b", "binary")).names
    with pytest.raises(MapError, match="names with spaces, which COLMAP reads in binary"):
        foreign.read(write(model, tmp_path / "t", "text"))
