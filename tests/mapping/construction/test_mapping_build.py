"""A map built from a known room is that room, and COLMAP reads the same from its folder."""

from __future__ import annotations

import dataclasses
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ground_station.errors import InputError, MapError
from ground_station.geometry import poses
from ground_station.geometry.alignment import align
from ground_station.geometry.camera import Camera
from ground_station.map import colmap, store
from ground_station.map.refined import Refined
from ground_station.mapping.construction import build
from ground_station.mapping.construction.cache import Cache
from ground_station.mapping.refinement.refine import refine_map
from ground_station.recording.frames import Frame

pycolmap = colmap.pycolmap


def test_poses_and_points_of_the_room_are_recovered(built):
    kf, lm = built.map.keyframes, built.map.landmarks
    assert kf.names == [f"frame-{k:06d}" for k in range(len(built.scene.wTc))]
    truth = built.scene.wTc
    fit = align(kf.wTc[:, :3, 3], truth[:, :3, 3], True)
    found = fit.apply_poses(kf.wTc)
    assert np.linalg.norm(found[:, :3, 3] - truth[:, :3, 3], axis=1).max() < 0.01
    turned = found[:, :3, :3] @ np.swapaxes(truth[:, :3, :3], 1, 2)
    assert np.degrees(poses.rotation_angle(turned)).max() < 0.2
    distance = np.linalg.norm(fit.apply(lm.position_m)[:, None] - built.scene.points, axis=2)
    assert len(lm) > 200
    assert np.median(distance.min(axis=1)) < 0.01


def test_colmap_reads_the_same_positions_poses_and_projections(built):
    model = pycolmap.Reconstruction(built.folder / "sparse")
    loaded = store.load(built.folder)
    lm, kf, camera = loaded.landmarks, loaded.keyframes, loaded.info.camera
    assert sorted(model.point3D_ids()) == lm.id.tolist()
    assert np.allclose([model.points3D[i].xyz for i in lm.id.tolist()], lm.position_m, atol=1e-12)
    by_name = {image.name: image for image in model.images.values()}
    for k, name in enumerate(kf.names):
        image = by_name[name]
        assert np.allclose(image.cam_from_world().inverse().matrix(), kf.wTc[k, :3], atol=1e-12)
        mine = kf.landmark[kf.offset[k] : kf.offset[k + 1]]
        local = poses.transform(poses.inverse(kf.wTc[k]), lm.position_m[mine])
        ours = camera.project(local)
        theirs = np.array([image.project_point(p) for p in lm.position_m[mine]])
        assert np.allclose(ours + 0.5, theirs, atol=1e-6)


def test_colmap_observes_the_keyframes_pixels_half_a_pixel_on(built):
    model = pycolmap.Reconstruction(built.folder / "sparse")
    kf, lm = built.map.keyframes, built.map.landmarks
    image = next(image for image in model.images.values() if image.name == kf.names[4])
    rows = slice(kf.offset[4], kf.offset[5])
    theirs = {p.point3D_id: p.xy for p in image.points2D if p.has_point3D()}
    assert len(theirs) == rows.stop - rows.start
    expected = kf.pixel_px[rows] + 0.5
    got = [theirs[i] for i in lm.id[kf.landmark[rows]].tolist()]
    assert np.allclose(got, expected, atol=1e-3)  # the database keeps float32


def test_observations_lie_where_the_landmarks_project(built):
    kf, lm = built.map.keyframes, built.map.landmarks
    for k in range(len(kf)):
        rows = slice(kf.offset[k], kf.offset[k + 1])
        local = poses.transform(poses.inverse(kf.wTc[k]), lm.position_m[kf.landmark[rows]])
        error = np.linalg.norm(built.scene.camera.project(local) - kf.pixel_px[rows], axis=1)
        assert np.median(error) < 0.6
        assert error.max() < 4


def test_cones_and_distances_hold_every_camera_that_saw_a_landmark(built):
    kf, lm = built.map.keyframes, built.map.landmarks
    image = np.repeat(np.arange(len(kf)), np.diff(kf.offset))
    rays = kf.wTc[image, :3, 3] - lm.position_m[kf.landmark]
    distance = np.linalg.norm(rays, axis=1)
    cos = np.sum(rays / distance[:, None] * lm.view_direction[kf.landmark], axis=1)
    assert (cos >= lm.view_cos[kf.landmark] - 1e-5).all()
    near, far = lm.distance_m[kf.landmark].T
    assert ((distance >= near * (1 - 1e-5)) & (distance <= far * (1 + 1e-5))).all()
    assert (np.bincount(kf.landmark, minlength=len(lm)) == lm.observations).all()
    assert lm.observations.min() >= built.settings.sfm.min_track


def test_descriptors_are_unit_means_and_the_quantised_ones_within_a_degree(built):
    exact, loaded = built.map.landmarks.descriptor, store.load(built.folder).landmarks.descriptor
    assert np.allclose(np.linalg.norm(exact, axis=1), 1, atol=1e-5)
    assert np.allclose(np.linalg.norm(loaded, axis=1), 1, atol=1e-5)
    angle = np.degrees(np.arccos(np.clip((exact * loaded).sum(axis=1), -1, 1)))
    assert angle.max() < 1


def test_the_loss_is_as_wide_as_the_noise_and_a_map_that_cannot_be_adjusted_says_so(
    built, use_scene, tmp_path, monkeypatch, capsys
):
    use_scene(built.scene)
    losses, adjust = [], build.adjust_and_filter

    def noted(reconstruction, sfm, threads):
        losses.append(sfm.loss_px)
        return adjust(reconstruction, sfm, threads)

    def refuse(*_):
        raise MapError("too few")

    monkeypatch.setattr(build, "adjust_and_filter", noted)
    monkeypatch.setattr(build, "straighten", refuse)
    map_ = build.build_map(
        built.scene.frames(), built.scene.camera, built.settings, tmp_path / "map"
    )
    assert set(losses) == {max(map_.info.built["noise_px"], 0.1)} != {built.settings.sfm.loss_px}
    note = "the rolling shutter stays in the map: too few"
    assert map_.info.built["notes"][-1] == note
    assert store.load_info(tmp_path / "map").built["notes"][-1] == note
    assert not capsys.readouterr().out


def test_map_toml_says_how_it_was_built(built):
    info = store.load_info(built.folder)
    assert info.frame == "sfm" and info.units == "arbitrary" and not info.registered
    assert info.features == "scene" and info.dimension == 32
    assert info.camera == built.scene.camera
    assert info.built["registered"] == len(built.scene.wTc)
    assert info.built["settings"]["seed"] == 0 and info.built["threads"] == 2
    assert 0.15 < info.built["sigma_px"] < 0.5  # 0.3 px was added


def _noise_frames(count: int, size: tuple[int, int] = (480, 640)):
    rng = np.random.default_rng(0)
    for k in range(count):
        yield Frame(k, f"noise-{k}.png", k, rng.integers(0, 256, size, dtype=np.uint8))


@pytest.mark.parametrize(
    ("frames", "error", "words"),
    [
        (lambda: _noise_frames(0), InputError, "at least 2 frames; the input has 0"),
        (lambda: _noise_frames(1), InputError, "at least 2 frames; the input has 1"),
        (lambda: _noise_frames(3), MapError, "no two of the 3 images overlap"),
        (lambda: _noise_frames(2, (240, 320)), MapError, "is 320x240 pixels, the camera 640x480"),
    ],
)
def test_frames_that_give_no_map_are_refused_in_one_line(tmp_path, frames, error, words):
    from ground_station.mapping.settings import MappingSettings

    with pytest.raises(error, match=words) as caught:
        build.build_map(frames(), Camera(), MappingSettings(max_features=200), tmp_path / "map")
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


_BLOCKED = """
import signal, sys
# A suite that runs in the background inherits an ignored SIGINT; a person's shell does not.
signal.signal(signal.SIGINT, signal.default_int_handler)
from pathlib import Path
import numpy as np
from ground_station.geometry.camera import Camera
from ground_station.mapping.construction.build import build_map
from ground_station.mapping.settings import MappingSettings
from ground_station.recording.frames import Frame

def frames():
    for k in range(20):
        yield Frame(k, str(k), k, np.zeros((480, 640), np.uint8))
    print("reading", flush=True)
    sys.stdin.read()

build_map(frames(), Camera(), MappingSettings(), Path(sys.argv[1]))
"""


def test_ctrl_c_ends_a_build_and_leaves_the_old_map_whole(built, target):
    with subprocess.Popen(
        [sys.executable, "-c", _BLOCKED, str(target)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
        cwd=Path(__file__).parents[3],
    ) as process:  # fmt: skip
        assert process.stdout is not None
        assert process.stdout.readline() == "reading\n"
        process.send_signal(signal.SIGINT)
        assert process.wait(30) != 0
    loaded = store.load(target)
    assert np.array_equal(loaded.landmarks.position_m, built.map.landmarks.position_m)
    assert pycolmap.Reconstruction(target / "sparse").num_points3D() == len(loaded.landmarks)


def test_the_rolling_shutter_is_taken_out_as_the_last_step(built, use_scene, tmp_path):
    """As adjusting the finished map would do it."""
    use_scene(built.scene)
    camera = dataclasses.replace(built.scene.camera, readout_s=0.02)
    sfm = dataclasses.replace(built.settings.sfm, rolling_shutter=False)
    left = dataclasses.replace(built.settings, sfm=sfm)
    with Cache(tmp_path / "cache") as cache:
        before = build.build_map(built.scene.frames(), camera, left, tmp_path / "left", cache=cache)
        straight = build.build_map(
            built.scene.frames(), camera, built.settings, tmp_path / "straight", cache=cache
        )
    assert not Refined.of(before).runs and Refined.of(straight).runs == 1
    after, _ = refine_map(tmp_path / "left", (), built.settings, out=tmp_path / "after")
    read = store.load(tmp_path / "straight")
    assert np.allclose(read.landmarks.position_m, after.landmarks.position_m, atol=1e-6)
    assert np.allclose(read.keyframes.wTc, after.keyframes.wTc, atol=1e-6)
    assert np.array_equal(read.landmarks.descriptor[:], after.landmarks.descriptor[:])
    model = colmap.to_arrays(colmap.read(tmp_path / "straight" / "sparse"))
    assert np.allclose(model.wTc, read.keyframes.wTc, atol=1e-6)
