"""A COLMAP model becomes a map: its poses and camera, our landmarks, where the points were."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
from foreign_model import foreign_model, image_name, write, write_pictures
from hand_made import run

from ground_station.commands import maps
from ground_station.errors import InputError, MapError
from ground_station.features import extractors
from ground_station.geometry import poses
from ground_station.geometry.epipolar import essential, sampson_px
from ground_station.localization.estimate import State
from ground_station.localization.localizer import Localizer
from ground_station.localization.settings import load_preset
from ground_station.map import colmap, store
from ground_station.mapping.importing.build import covisible_pairs, import_model
from ground_station.mapping.importing.pictures import open_pictures, taken_by
from ground_station.mapping.sfm import foreign


@pytest.fixture(scope="module")
def scene(built):
    return built.scene


@pytest.fixture(scope="module")
def pictures(scene, tmp_path_factory):
    return write_pictures(scene, tmp_path_factory.mktemp("pictures"))


@pytest.fixture(scope="module")
def model_folder(scene, tmp_path_factory):
    return write(foreign_model(scene), tmp_path_factory.mktemp("models") / "text", "text")


@pytest.fixture
def imported(scene, pictures, model_folder, scene_settings, use_scene, tmp_path):
    use_scene(scene)
    model = foreign.read(model_folder)
    frames = open_pictures(pictures, model.names, 30.0)
    return import_model(model, frames, model.camera, scene_settings, tmp_path / "hall")


def test_poses_are_the_models_and_landmarks_lie_where_the_points_were(imported, scene):
    kf, lm = imported.keyframes, imported.landmarks
    assert kf.names == [image_name(k) for k in range(16)]
    assert np.abs(kf.wTc - scene.wTc).max() < 1e-9
    off = np.linalg.norm(lm.position_m[:, None] - scene.points, axis=2)
    assert len(lm) > 200
    assert np.median(off.min(axis=1)) < 0.01
    assert (off.min(axis=1) < 0.1).mean() > 0.98
    assert imported.info.camera == dataclasses.replace(scene.camera, readout_s=0.0)
    assert imported.info.frame == "sfm" and not imported.info.registered
    assert lm.observations.min() >= 3


def test_the_folder_holds_the_map_and_its_model_agrees(imported):
    loaded = store.load(imported.folder)
    assert np.array_equal(loaded.keyframes.wTc, imported.keyframes.wTc)
    model = colmap.to_arrays(colmap.read(imported.folder / "sparse"))
    assert model.names == loaded.keyframes.names
    assert np.abs(model.wTc - loaded.keyframes.wTc).max() < 1e-9
    assert np.abs(model.position - loaded.landmarks.position_m).max() < 1e-9
    assert not (imported.folder / "work").exists()


def test_a_frame_is_localized_in_it(imported, scene):
    map_ = store.load(imported.folder)
    localizer = Localizer(map_, scene.camera, extractors.create("scene"), load_preset("default"))
    truth = scene.wTc[6]
    localizer.set_initial_pose(truth @ poses.exp([0.01, -0.01, 0.0, 0.03, 0.0, 0.02]), 0)
    estimate = localizer.process_features(0, scene.features[6])
    assert estimate.state is State.TRACKING, estimate.reason
    apart = poses.log(poses.inverse(truth) @ estimate.wTc)
    assert np.linalg.norm(apart[3:]) < 0.02 and np.linalg.norm(apart[:3]) < 0.005


def test_the_command_says_what_is_missing_and_keeps_the_rest(
    scene, pictures, model_folder, use_scene, tmp_path, capsys
):
    use_scene(scene)
    folder = tmp_path / "pictures"
    for path in sorted((pictures / "db").iterdir())[:-2]:
        (folder / "db").mkdir(parents=True, exist_ok=True)
        (folder / "db" / path.name).symlink_to(path)
    out = tmp_path / "hall"
    words = (maps, "import", model_folder, "--images", folder, "--features", "scene", "--out", out)
    assert run(*words, "--json", tmp_path / "figures.json") == 0
    said = capsys.readouterr().out
    assert "14 of the model's 16 images are in the map" in said
    assert f"2 have no picture: {image_name(14)}, {image_name(15)}" in said
    info = store.load_info(out)
    assert info.built["images"] == 16 and info.built["registered"] == 14
    assert info.built["source"] == "COLMAP model" and info.built["inputs"] == ["pictures"]
    assert (tmp_path / "figures.json").is_file()


def test_a_maps_own_model_comes_back_with_the_lens_of_its_pictures(
    built, use_scene, scene_settings, tmp_path
):
    use_scene(built.scene)
    model = foreign.read(built.folder / "sparse")
    assert model.camera == dataclasses.replace(built.scene.camera, readout_s=0.0)
    names = {frame.name: frame for frame in built.scene.frames()}
    again = import_model(
        model, [names[name] for name in model.names], built.scene.camera, scene_settings,
        tmp_path / "again",
    )  # fmt: skip
    assert np.abs(again.keyframes.wTc - built.map.keyframes.wTc).max() < 1e-9
    assert len(again.landmarks) > 0.9 * len(built.map.landmarks)
    assert again.info.camera == built.scene.camera
    assert again.info.built["sigma_px"] < 1.3 * built.map.info.built["sigma_px"]


def test_pictures_of_another_place_are_refused(
    scene, model_folder, use_scene, scene_settings, tmp_path
):
    rng = np.random.default_rng(0)
    others = [
        dataclasses.replace(f, descriptors=rng.permutation(f.descriptors)) for f in scene.features
    ]
    use_scene(dataclasses.replace(scene, features=others))
    model = foreign.read(model_folder)
    frames = [dataclasses.replace(f, name=image_name(f.index)) for f in scene.frames()]
    with pytest.raises(MapError, match="are these the pictures that it was made of") as caught:
        import_model(model, frames, model.camera, scene_settings, tmp_path / "hall")
    assert "\n" not in str(caught.value) and not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"names": []}, InputError, "at least 2 frames; the input has 0"),
        ({"points": 16 * [np.empty(0, np.uint64)]}, InputError, "share 15 points of the model"),
    ],
)
def test_a_model_without_pictures_or_points_is_refused(
    scene, pictures, model_folder, use_scene, scene_settings, tmp_path, changes, error, words
):
    use_scene(scene)
    model = dataclasses.replace(foreign.read(model_folder), **changes)
    with pytest.raises(error, match=words):
        import_model(
            model, open_pictures(pictures, model.names, 30.0), model.camera, scene_settings,
            tmp_path / "hall",
        )  # fmt: skip
    assert not list(tmp_path.iterdir())


def test_an_unreadable_picture_is_named(pictures, tmp_path):
    (tmp_path / "a.png").write_bytes(b"nothing")
    with pytest.raises(InputError, match=r"a.png: not a whole, readable image"):
        list(open_pictures(tmp_path, ["a.png"], 30.0))
    with pytest.raises(InputError, match="the frame rate is 0"):
        open_pictures(tmp_path, ["a.png"], 0.0)


class Source:
    """A recording of four frames."""

    camera = None
    notes: list[str] = []  # noqa: RUF012

    def __iter__(self):
        from ground_station.recording.frames import Frame

        return (Frame(k, f"frame-{k:06d}", k * 7, np.zeros((2, 2), np.uint8)) for k in range(4))


def test_frames_of_a_recording_are_found_by_their_numbers():
    from ground_station.mapping.importing.pictures import Pictures

    names = ["frame-000001.png", "frame-000003", "walk/frame-000002.jpg", "other/frame-000000"]
    found = list(Pictures(names, Source(), 30.0, "walk"))
    assert [(f.name, f.time_ns) for f in found] == [
        ("frame-000001.png", 7), ("walk/frame-000002.jpg", 14), ("frame-000003", 21),
    ]  # fmt: skip
    with pytest.raises(InputError, match="would be the same frame"):
        list(Pictures(["frame-000001.png", "frame-000001.jpg"], Source(), 30.0, "walk"))


def test_a_recordings_camera_counts_where_the_model_is_of_undistorted_pictures(scene):
    ours = scene.camera
    flat = dataclasses.replace(ours, k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0, readout_s=0.0)
    camera, note = taken_by(flat, ours)
    assert camera == ours and "undistorted" in note
    assert taken_by(flat, flat) == (flat, "")
    near = dataclasses.replace(ours, fx_px=ours.fx_px + 0.5)
    assert taken_by(near, ours) == (near, "")
    far = dataclasses.replace(ours, k1=0.0)
    camera, note = taken_by(far, ours)
    assert camera == far and "px off the model's, which is taken" in note


def test_epipolar_distances_are_those_of_the_geometry(scene):
    i, j = 2, 9
    both = np.intersect1d(scene.seen[i], scene.seen[j])
    K = scene.camera.matrix
    pixels = []
    for k in (i, j):
        local = poses.transform(poses.inverse(scene.wTc[k]), scene.points[both])
        pixels.append(local[:, :2] / local[:, 2:] * [K[0, 0], K[1, 1]] + K[:2, 2])
    E = essential(scene.wTc[i], scene.wTc[j])
    assert sampson_px(*pixels, E, K).max() < 1e-6
    # Of a shift across its line a pixel needs to move back by a part, the other by the rest.
    F = np.linalg.inv(K).T @ E @ np.linalg.inv(K)
    line = np.column_stack([pixels[0], np.ones(len(both))]) @ F.T
    normal = line[:, :2] / np.linalg.norm(line[:, :2], axis=1, keepdims=True)
    shifted = sampson_px(pixels[0], pixels[1] + 3 * normal, E, K)
    assert (shifted > 1.5).all() and (shifted < 3).all()
    theirs = [
        cv2.sampsonDistance(np.append(p, 1)[:, None], np.append(q, 1)[:, None], F)
        for p, q in zip(pixels[0], pixels[1] + 3 * normal, strict=True)
    ]
    assert shifted == pytest.approx(np.sqrt(theirs), rel=1e-6)
    assert np.isnan(sampson_px(*pixels, essential(scene.wTc[i], scene.wTc[i]), K)).all()


def test_pairs_are_those_that_share_most():
    shared = {(0, 1): 30, (0, 2): 5, (0, 3): 20, (1, 2): 40}
    points = [[], [], [], []]
    for number, (pair, count) in enumerate(shared.items()):
        for image in pair:
            points[image] += range(100 * number, 100 * number + count)
    arrays = [np.array(numbers, np.uint64) for numbers in points]
    assert covisible_pairs(arrays, least=10, most=1) == [(0, 1), (0, 3), (1, 2)]
    assert covisible_pairs(arrays, least=25, most=9) == [(0, 1), (1, 2)]
    assert covisible_pairs([np.empty(0, np.uint64)] * 3, least=1, most=9) == []
