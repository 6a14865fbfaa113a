"""A lens is found where the views decide it, and refused or kept where they do not."""

from __future__ import annotations

import copy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hand_made import in_picture, observed
from scipy.spatial.transform import Rotation

from ground_station.errors import MapError
from ground_station.features.extractor import Features
from ground_station.geometry import camera as cameras
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.map import colmap
from ground_station.map.model import Model
from ground_station.mapping.construction import lens
from ground_station.mapping.construction.first_lens import LensPrior
from ground_station.mapping.construction.images import Images
from ground_station.mapping.construction.lens_adjustment import PARAMETERS, adjust, vector
from ground_station.mapping.refinement import shutter
from ground_station.mapping.settings import MappingSettings
from ground_station.mapping.sfm import adjustment
from ground_station.mapping.sfm.models import among

CAMERA = replace(cameras.THESIS_CAMERA, readout_s=0.0)
NOISE_PX = 0.3
STEP_S = 0.25
NORTH = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Camera axes in the world's, looking along +y."""


def _flight(turns: bool, seed: int, images: int = 18, points: int = 300):
    """True poses and points: through a corridor, turning and swaying, or straight on."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform([-2.0, 2.0, -1.3], [2.0, 16.0, 1.3], (points, 3))
    side = rng.integers(0, 2, points)
    xyz[np.arange(points), 2 * side] = np.sign(rng.normal(size=points)) * np.where(side, 1.3, 2.0)
    y = np.linspace(0, 6, images)
    centres = np.stack([0 * y, y, 0 * y], axis=1)
    rotation = np.tile(NORTH, (images, 1, 1))
    if turns:
        centres[:, 0], centres[:, 2] = np.sin(1.3 * y), 0.5 * np.cos(2.1 * y)
        turn = np.stack([0.2 * np.sin(2 * y), 0.5 * np.sin(1.7 * y), 0.3 * np.cos(y)], axis=1)
        rotation = rotation @ Rotation.from_rotvec(turn).as_matrix()
    return poses.pose(rotation, centres), xyz


def _views(camera: Camera, wTc, xyz, seed: int) -> tuple[Images, Model]:
    """What the camera sees as a build has it: noisy key points, and the model they belong to.

    Its rows are exposed one after the other where it has a readout.
    """
    step = [poses.log(each) for each in poses.inverse(wTc[:-1]) @ wTc[1:]]
    step = np.array([*step, step[-1]]) / STEP_S
    rng = np.random.default_rng(seed)
    rows, features = [], []
    for k, T in enumerate(wTc):
        local = poses.transform(poses.inverse(T), xyz)
        pixel = camera.project(local)
        if camera.readout_s:
            row_s = shutter.row_times_s(np.nan_to_num(pixel[:, 1]), camera)
            there = poses.inverse(np.array([poses.exp(one * step[k]) for one in row_s.tolist()]))
            pixel = camera.project(
                np.einsum("nij,nj->ni", there[:, :3, :3], local) + there[:, :3, 3]
            )
        seen = np.flatnonzero(in_picture(camera, local, pixel, 0.8))
        noisy = pixel[seen] + NOISE_PX * rng.normal(size=(len(seen), 2))
        count = len(seen)
        features.append(
            Features(noisy.astype("f4"), np.ones(count, "f4"), np.zeros((count, 4), "f4"))
        )
        rows.append((seen, noisy))
    model, used = observed(camera, wTc, xyz, rows, least=3)
    feature = np.concatenate([np.arange(len(seen)) for seen, _ in rows])[used]
    time_ns = (np.arange(len(wTc)) * 1e9 * STEP_S).astype(np.int64)
    pixels = [f.keypoints_px.astype(float) for f in features]
    return Images(model.names, time_ns, features, pixels), replace(model, feature=feature)


def _adjusted_with(camera: Camera, images: Images, model: Model) -> Model:
    """The model as a build makes it with that camera held: poses and points bent by its errors."""
    undistorted = lens.with_lens(images, camera)
    pixels = np.empty((len(model.image), 2))
    for k in range(len(model.names)):
        rows = model.image == k
        pixels[rows] = undistorted.pinhole_px[k][model.feature[rows]]
    model = replace(model, pixel_px=pixels)
    reconstruction = colmap.from_arrays(model, camera)
    adjustment.adjust(reconstruction, loss_px=1.0, threads=1)
    wTc, position = colmap.positions(reconstruction, model)
    return replace(model, wTc=wTc, position=position)


def _with_rows(model: Model, rows) -> Model:
    """The model with some of its observations (O,)."""
    names = ("image", "feature", "point", "pixel_px")
    return replace(model, **{name: getattr(model, name)[rows] for name in names})


def _off(camera: Camera, share: float, distorted: bool = True) -> Camera:
    wrong = replace(camera, fx_px=share * camera.fx_px, fy_px=share * camera.fy_px)
    return wrong if distorted else replace(wrong, k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0)


def _judged(known: LensPrior, turns: bool = True, seed: int = 1, true: Camera = CAMERA):
    """A build's rounds over one flight, its images placed with each lens in turn."""
    images, model = _views(true, *_flight(turns, seed), seed)
    calibration = lens.SelfCalibration(known, images, MappingSettings())
    while calibration.go_on(_adjusted_with(calibration.camera, images, model), images):
        pass
    return calibration


@pytest.mark.parametrize("seed", range(4))
def test_a_lens_is_found_within_what_is_said_of_it(seed):
    wrong = _off(CAMERA, 1.04, distorted=False)
    images, model = _views(CAMERA, *_flight(True, seed, images=24, points=500), seed)
    model = _adjusted_with(wrong, images, model)
    known = LensPrior(wrong, "guess", 0.2)
    found = adjust(lens._as_seen(model, images, wrong, 0.0), wrong, lens.prior_of(known, wrong))
    assert found is not None
    off = np.abs(vector(found.camera) - vector(CAMERA)) / found.sigmas
    assert off.max() < 4, dict(zip(PARAMETERS, off.round(1), strict=True))
    assert found.sigma_focal < 0.005 and found.explained > 0.5
    assert found.sigma_px == pytest.approx(NOISE_PX, rel=0.1)


def test_a_point_at_a_camera_s_centre_changes_nothing():
    images, model = _views(CAMERA, *_flight(True, 1), 1)
    model = lens._as_seen(model, images, CAMERA, 0.0)
    pair = np.array([4, 5])  # the first sees the second's centre
    point = poses.transform(model.wTc[5], np.array([[0, 0, 1e-8]]))
    seen = [CAMERA.project(poses.transform(poses.inverse(model.wTc[k]), point)) for k in pair]
    more = replace(
        model,
        point_id=np.append(model.point_id, 10_000),
        position=np.concatenate([model.position, point]),
        image=np.append(model.image, pair),
        feature=np.append(model.feature, [0, 0]),
        point=np.append(model.point, [len(model.position)] * 2),
        pixel_px=np.concatenate([model.pixel_px, *seen]),
    )
    prior = lens.prior_of(LensPrior(CAMERA, "file", 0.0), CAMERA)
    without, with_it = (adjust(each, CAMERA, prior) for each in (model, more))
    assert with_it.sigmas == pytest.approx(without.sigmas, rel=0.02)
    assert np.abs(vector(with_it.camera) - vector(without.camera)).max() < 0.02
    assert with_it.explained == pytest.approx(without.explained, abs=0.002)


def test_an_image_that_held_by_one_that_is_left_out_goes_with_it():
    images, model = _views(CAMERA, *_flight(True, 1), 1)
    model = lens._as_seen(model, images, CAMERA, 0.0)
    first, second = (set(model.point[model.image == k].tolist()) for k in (8, 9))
    own = sorted(first & second)[:12]  # the second sees one fewer of them: too few
    ours = np.isin(model.point, own)
    rows = ours == np.isin(model.image, [8, 9])
    rows &= ~((model.image == 9) & (model.point == own[-1]))
    prior = lens.prior_of(LensPrior(CAMERA, "file", 0.0), CAMERA)
    others = among(_with_rows(model, rows), ~np.isin(np.arange(len(model.names)), [8, 9]))
    found, without = (adjust(each, CAMERA, prior) for each in (_with_rows(model, rows), others))
    assert found is not None and vector(found.camera) == pytest.approx(vector(without.camera))


def test_the_covariance_holds_over_many_flights():
    """Of 12 flights the mean square of the focal length's error in sigmas is that of a sigma."""
    off = []
    for seed in range(12):
        images, model = _views(CAMERA, *_flight(True, seed, images=16, points=250), seed)
        known = LensPrior(CAMERA, "guess", 0.2)
        found = adjust(
            lens._as_seen(model, images, CAMERA, 0.0), CAMERA, lens.prior_of(known, CAMERA)
        )
        assert found is not None
        off.append((found.camera.fx_px - CAMERA.fx_px) / found.sigmas[0])
    rms = np.sqrt(np.mean(np.square(off)))
    assert 0.2 < rms < 1.3


def test_a_wrong_camera_file_is_named_and_the_lens_found_is_used():
    for share, distorted in ((1.03, True), (0.98, True), (1.05, False)):
        known = LensPrior(_off(CAMERA, share, distorted), "file", 0.02)
        calibration = _judged(known)
        assert calibration.camera.fx_px == pytest.approx(CAMERA.fx_px, rel=0.005)
        built = calibration.as_built()
        assert built["state"] == "found"
        assert built["given"]["fx_px"] == pytest.approx(known.camera.fx_px)
        (note,) = calibration.notes()
        assert "the given camera misfits" in note and "blimp calibrate" in note


@pytest.mark.parametrize("swings", [0.0005, 0.006])
def test_a_lens_that_goes_to_and_fro_stands_if_that_is_little(monkeypatch, swings):
    """Each model has other points: a lens may never settle within its deviations."""

    def swinging(model, camera, prior):
        if camera.fx_px == known.camera.fx_px:
            first.append(adjust(model, camera, prior))
            return first[-1]
        found = first[0]
        side = 1 - swings if camera.fx_px > CAMERA.fx_px else 1 + swings
        return replace(found, camera=_off(CAMERA, side), covariance=1e-4 * found.covariance)

    first = []
    known = LensPrior(_off(CAMERA, 1.03), "file", 0.02)
    monkeypatch.setattr(lens, "adjust", swinging)
    monkeypatch.setattr(lens, "_SETTLED", 0.0)
    if swings > 0.004:
        with pytest.raises(MapError, match="after 5 rounds it has not settled"):
            _judged(known)
        return
    calibration = _judged(known)
    assert calibration.rounds == lens.ROUNDS and calibration.as_built()["state"] == "found"
    assert calibration.camera.fx_px == pytest.approx(CAMERA.fx_px, rel=0.001)


def test_a_lens_that_half_of_the_images_denies_is_kept_and_that_is_said(monkeypatch):
    """What comes from how the camera moved, as of a rolling shutter, is no fault of the file."""
    images, model = _views(CAMERA, *_flight(True, 1), 1)
    centre = np.array([CAMERA.cx_px, CAMERA.cy_px], np.float32)
    features = [
        replace(each, keypoints_px=centre + 0.93 * (each.keypoints_px - centre))
        if k < len(model.names) // 2 else each
        for k, each in enumerate(images.features)
    ]  # fmt: skip
    images = replace(images, features=features)
    known = LensPrior(CAMERA, "file", 0.0)
    calibration = lens.SelfCalibration(known, images, MappingSettings())
    model = _adjusted_with(CAMERA, images, model)
    found = adjust(lens._as_seen(model, images, CAMERA, 0.0), CAMERA, lens.prior_of(known, CAMERA))
    assert found is not None and found.explained > 0.5
    assert calibration.go_on(model, images)  # the other is tried, and half denies it as well
    in_vain = copy.copy(calibration)
    with monkeypatch.context() as patch:
        patch.setattr(lens, "adjust", lambda *_: None)  # its model is too small for a lens
        assert not in_vain.go_on(model, images)
    assert in_vain.as_built()["state"] == "kept"
    model = _adjusted_with(calibration.camera, images, model)
    assert not calibration.go_on(model, images)
    assert calibration.camera == CAMERA and calibration.as_built()["state"] == "kept"
    (note,) = calibration.notes()
    assert "is kept" in note and "a part of them" in note and "blimp calibrate" in note


def test_a_rolling_shutter_is_not_taken_for_a_lens():
    rolling = replace(CAMERA, readout_s=0.03)
    images, model = _views(rolling, *_flight(True, 1, images=24), 1)
    model = _adjusted_with(CAMERA, images, model)
    prior = lens.prior_of(LensPrior(CAMERA, "file", 0.0), CAMERA)
    found = adjust(lens._as_seen(model, images, CAMERA, 0.0), CAMERA, prior)
    assert found is not None and found.explained > 0.5
    for known in (rolling, CAMERA):  # the file says it, or does not
        calibration = lens.SelfCalibration(LensPrior(known, "file", 0.0), images, MappingSettings())
        placed = model
        while calibration.go_on(placed, images):
            placed = _adjusted_with(calibration.camera, images, placed)
        assert calibration.camera == known and calibration.rounds <= 2


@pytest.mark.parametrize("fewer", [False, True])
def test_a_lens_that_a_bent_model_denies_proves_itself_in_its_own(fewer):
    """Of a folded model one half's lens foretells nothing of the other's, though it is wrong."""
    wrong = _off(CAMERA, 1.02)
    images, model = _views(CAMERA, *_flight(True, 1), 1)
    calibration = lens.SelfCalibration(LensPrior(wrong, "file", 0.02), images, MappingSettings())
    bent = _adjusted_with(wrong, images, model)
    centre = np.array([CAMERA.cx_px, CAMERA.cy_px], np.float32)
    half = [
        replace(each, keypoints_px=centre + share * (each.keypoints_px - centre))
        for k, each in enumerate(images.features)
        for share in [1.015 if k < len(model.names) // 2 else 0.965]
    ]
    rows = np.arange(len(bent.image))
    bent = _with_rows(bent, rows % 20 > 0)  # what fits the bent model
    assert calibration.go_on(bent, replace(images, features=half))
    assert calibration.as_built()["state"] == "tried"
    own = _adjusted_with(calibration.camera, images, model)
    if fewer:
        own = _with_rows(own, rows % 10 > 0)
    while calibration.go_on(own, images):
        own = _adjusted_with(calibration.camera, images, own)
    assert calibration.as_built()["state"] == ("kept" if fewer else "found")
    true = wrong if fewer else CAMERA
    assert calibration.camera.fx_px == pytest.approx(true.fx_px, rel=0.005)


@pytest.mark.parametrize(
    "left, proven",
    [
        ([(0.0171, 0.1288), (0.0051, 0.0354)], True),  # a simulated walk, its lens 1 % off
        ([(0.1009, 0.2176), (0.0357, 0.679)], False),  # a real kitchen's rolling shutter
    ],
)
def test_both_halves_of_a_tried_lens_must_deny_the_known_one_by_far(monkeypatch, left, proven):
    """By what each half's lens leaves in the other, and what the known one leaves, as measured."""
    known, better = _off(CAMERA, 1.04), replace(CAMERA, cx_px=CAMERA.cx_px + 1)
    halves = tuple(
        SimpleNamespace(camera=better, left_by=lambda by, two=two: two[by == known])
        for two in left
    )  # fmt: skip
    images, _ = _views(CAMERA, *_flight(True, 1), 1)
    calibration = lens.SelfCalibration(LensPrior(known, "file", 0.0), images, MappingSettings())
    monkeypatch.setattr(calibration, "_halves", lambda *_: halves)
    found = SimpleNamespace(camera=CAMERA, sigma_focal=0.005)
    assert calibration._proves(found, None, None) == proven


def test_a_file_that_misfits_is_not_kept_silently_where_the_images_leave_the_lens_open(monkeypatch):
    known = LensPrior(replace(CAMERA, k1=-0.3, k2=0.0), "file", 0.02)
    calibration = _judged(known, turns=False)
    assert calibration.as_built()["state"] == "open" and calibration.camera == known.camera
    assert "may be bent" in calibration.notes()[0]
    monkeypatch.setattr(lens, "_GROSS", 0.05)  # by more than all else: it is refused
    with pytest.raises(MapError, match=r"the given camera is not this one's.*'blimp calibrate'"):
        _judged(known, turns=False)


def test_a_lens_found_by_which_no_model_is_found_is_left_open():
    images, model = _views(CAMERA, *_flight(True, 1), 1)
    known = LensPrior(_off(CAMERA, 1.05, distorted=False), "file", 0.0)
    calibration = lens.SelfCalibration(known, images, MappingSettings())
    error = MapError("no pair to start from")
    with pytest.raises(MapError, match="no pair to start from"):
        calibration.failed(error)
    assert calibration.go_on(_adjusted_with(known.camera, images, model), images)
    with pytest.raises(MapError, match="leave the lens open"):
        calibration.failed(error)


def test_a_lens_that_many_images_decided_is_not_reopened_by_few():
    images, model = _views(CAMERA, *_flight(True, 1), 1)
    known = LensPrior(_off(CAMERA, 1.05, distorted=False), "file", 0.0)
    calibration = lens.SelfCalibration(known, images, MappingSettings())
    assert calibration.go_on(_adjusted_with(known.camera, images, model), images)
    found = calibration.camera
    fewer = among(model, np.arange(len(model.names)) < 5)
    assert not calibration.go_on(_adjusted_with(known.camera, images, fewer), images)
    assert calibration.camera == found and calibration.as_built()["state"] == "found"


def test_the_views_may_change_both_focal_lengths_but_hardly_one_of_them():
    """A rolling shutter stretches a picture's height; a calibration knew fy over fx already."""
    for source, ratio in (("file", 0.0005), ("guess", 0.002)):
        known = LensPrior(CAMERA, source, 0.02)
        prior = lens.prior_of(known, CAMERA)
        fx, fy = prior.mean[:2]
        relative = prior.covariance[:2, :2] / np.outer([fx, fy], [fx, fy])
        assert np.sqrt([1, -1] @ relative @ [1, -1]) == pytest.approx(ratio)
        assert np.sqrt(relative[0, 0]) == pytest.approx(0.1, rel=0.01)


@pytest.mark.parametrize("turns", [True, False])
def test_a_right_camera_file_is_left_as_it_is(turns):
    for seed in range(3):
        calibration = _judged(LensPrior(CAMERA, "file", 0.02), turns, seed)
        assert calibration.camera == CAMERA and calibration.rounds == 1
        assert calibration.notes() == [] and calibration.as_built()["state"] == "given"


def test_straight_flight_down_a_corridor_leaves_a_guessed_lens_open(monkeypatch):
    guess = replace(Camera(), fx_px=560.0, fy_px=560.0, cx_px=319.5, cy_px=239.5)
    monkeypatch.setattr(lens, "rough_lens", lambda images, known, ratio: known.camera)
    with pytest.raises(MapError, match=r"straight on.*'blimp calibrate'.*--camera") as caught:
        _judged(LensPrior(guess, "guess", 0.2), turns=False)
    assert "\n" not in str(caught.value)


def test_the_same_guess_is_made_good_where_the_camera_turns(monkeypatch):
    guess = replace(Camera(), fx_px=560.0, fy_px=560.0, cx_px=319.5, cy_px=239.5)
    monkeypatch.setattr(lens, "rough_lens", lambda images, known, ratio: known.camera)
    calibration = _judged(LensPrior(guess, "guess", 0.2))
    assert calibration.camera.fx_px == pytest.approx(CAMERA.fx_px, rel=0.005)
    assert calibration.rounds > 1 and "lens found by the images" in calibration.notes()[0]


def test_a_lens_of_another_model_is_refused_by_name_where_nobody_calibrated_it():
    images, model = _views(CAMERA, *_flight(True, 1), 1)
    other = replace(CAMERA)
    object.__setattr__(other, "model", "fisheye")
    with pytest.raises(MapError, match=r"opencv5 only, not fisheye: calibrate it with 'blimp"):
        lens.SelfCalibration(LensPrior(other, "guess", 0.2), images, MappingSettings())
    calibration = lens.SelfCalibration(LensPrior(other, "file", 0.02), images, MappingSettings())
    assert not calibration.go_on(model, images) and calibration.camera == other


def _described(images: Images, model: Model) -> Images:
    """The images with descriptors by which their key points are matched."""
    descriptor = np.random.default_rng(0).normal(size=(len(model.position), 32))
    descriptor /= np.linalg.norm(descriptor, axis=1, keepdims=True)
    features = []
    for k, old in enumerate(images.features):
        rows = model.image == k
        pixels = old.keypoints_px[model.feature[rows]]
        ones = np.ones(len(pixels), "f4")
        features.append(Features(pixels, ones, descriptor[model.point[rows]].astype("f4")))
    return replace(images, features=features)


def test_a_rough_lens_is_found_from_a_guess_a_third_off(monkeypatch):
    monkeypatch.setattr(lens, "_PAIRS", 5)
    images, model = _views(CAMERA, *_flight(True, 2), 2)
    guess = replace(Camera(), fx_px=670.0, fy_px=670.0, cx_px=319.5, cy_px=239.5)
    found = lens.rough_lens(_described(images, model), LensPrior(guess, "guess", 0.3), 0.8)
    assert found.fx_px == pytest.approx(CAMERA.fx_px, rel=0.15)


def test_images_that_share_nothing_leave_the_lens_as_it_is_known():
    images, _ = _views(CAMERA, *_flight(True, 2), 2)
    known = LensPrior(CAMERA, "guess", 0.3)
    assert lens.rough_lens(images, known, 0.8) == CAMERA


def test_a_model_too_small_says_nothing_of_the_lens():
    wTc, xyz = _flight(True, 1, points=4)
    images, model = _views(CAMERA, wTc, xyz, 1)
    known = LensPrior(CAMERA, "file", 0.02)
    calibration = lens.SelfCalibration(known, images, MappingSettings())
    assert not calibration.go_on(model, images) and calibration.notes() == []
