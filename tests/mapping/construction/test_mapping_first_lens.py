"""The lens a build starts with: where it comes from, how far it may be off, and what is refused."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from hand_made import camera_file
from PIL import Image

from ground_station.errors import CameraError
from ground_station.geometry.camera import THESIS_CAMERA
from ground_station.geometry.resizing import scaled, turned
from ground_station.mapping.construction.first_lens import GUESS, KNOWN, SIGMA_GUESS
from ground_station.mapping.construction.inputs import open_inputs
from ground_station.mapping.settings import MappingSettings

SETTINGS = MappingSettings()
EXIF, ORIENTATION, FILM = 0x8769, 0x0112, 0xA405


def pictures(
    folder: Path, size: tuple[int, int] = (640, 480), film_mm: int = 0, orientation: int = 1
) -> str:
    folder.mkdir()
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    if film_mm:
        exif.get_ifd(EXIF)[FILM] = film_mm
    for k in range(2):
        image = Image.fromarray(np.full((size[1], size[0]), 50 * k, np.uint8))
        image.save(folder / f"{k}.jpg", exif=exif)
    return str(folder)


def test_without_any_word_of_the_lens_it_is_guessed_and_said_to_be(tmp_path: Path) -> None:
    inputs = open_inputs([pictures(tmp_path / "a", (480, 640))], SETTINGS)
    prior, camera = inputs.prior, inputs.camera
    assert (prior.source, prior.calibrated, prior.sigma_focal) == ("guess", False, SIGMA_GUESS)
    assert (camera.width_px, camera.height_px) == (480, 640)
    assert camera.fx_px == camera.fy_px == GUESS * 640  # of the longer side, portrait, too
    assert (camera.cx_px, camera.cy_px) == (239.5, 319.5) and not camera.distortion.any()
    (line,) = inputs.said
    assert "473 px is guessed" in line and "standard deviation 30 %" in line
    assert "blimp calibrate" in line


def test_the_guess_is_the_middle_of_known_cameras_and_holds_them_within_its_deviations() -> None:
    off = np.array([abs(math.log(value / GUESS)) for value in KNOWN.values()]) / SIGMA_GUESS
    below = sum(value < GUESS for value in KNOWN.values())
    assert abs(below - len(KNOWN) / 2) <= 1
    assert (off < 1).mean() > 0.6 and off.max() < 2.5


def test_metadata_go_before_a_guess_also_where_only_one_input_has_them(tmp_path: Path) -> None:
    paths = [pictures(tmp_path / "a"), pictures(tmp_path / "b", film_mm=26)]
    inputs = open_inputs(paths, SETTINGS)
    assert inputs.prior.source == "metadata" and not inputs.prior.calibrated
    assert inputs.camera.fx_px == pytest.approx(26 / math.hypot(36, 24) * 800)
    assert inputs.prior.sigma_focal < 0.1
    assert "EXIF FocalLengthIn35mmFilm 26 mm" in inputs.said[0]


def test_inputs_of_two_lenses_or_sizes_are_refused_by_name(tmp_path: Path) -> None:
    a = pictures(tmp_path / "a", film_mm=26)
    b, c = pictures(tmp_path / "b", film_mm=13), pictures(tmp_path / "c", (480, 640))
    with pytest.raises(CameraError, match=r"b: was taken with another lens .*13 mm.*26 mm"):
        open_inputs([a, b], SETTINGS)
    with pytest.raises(CameraError, match=r"c: its pictures are 480x640 px, those of .*a 640x480"):
        open_inputs([a, c], SETTINGS)


def test_a_file_goes_before_metadata_and_may_be_a_little_off(tmp_path: Path) -> None:
    camera = camera_file(tmp_path / "camera.toml", THESIS_CAMERA)
    inputs = open_inputs([pictures(tmp_path / "a", film_mm=26)], SETTINGS, camera=camera)
    assert inputs.camera == THESIS_CAMERA and inputs.said == []
    assert inputs.prior.source == "file" and inputs.prior.calibrated
    assert 0.01 <= inputs.prior.sigma_focal < 0.05


def test_a_file_of_another_size_is_scaled_to_the_pictures_and_it_is_said(tmp_path: Path) -> None:
    camera = camera_file(tmp_path / "camera.toml", scaled(THESIS_CAMERA, 1280, 960))
    inputs = open_inputs([pictures(tmp_path / "a")], SETTINGS, camera=camera)
    for name, value in THESIS_CAMERA.as_dict().items():
        assert getattr(inputs.camera, name) == pytest.approx(value), name
    assert "the camera is scaled" in inputs.said[0]


def test_a_file_of_pictures_as_shown_is_turned_to_the_stored_ones(tmp_path: Path) -> None:
    camera = camera_file(tmp_path / "camera.toml", turned(THESIS_CAMERA, 1))
    a = pictures(tmp_path / "a", orientation=6)
    inputs = open_inputs([a], SETTINGS, camera=camera)
    assert inputs.camera == THESIS_CAMERA and "turned to the stored ones" in inputs.said[0]
    assert inputs.built["display_deg"] == 90  # so that who draws the map knows what is up
    other_way = pictures(tmp_path / "b", orientation=8)
    with pytest.raises(CameraError, match=r"b: its pictures are 640x480 px, turned by 270°"):
        open_inputs([a, other_way], SETTINGS, camera=camera)
    with pytest.raises(CameraError, match=r"c: .*no rotation flag says which way"):
        open_inputs([pictures(tmp_path / "c")], SETTINGS, camera=camera)


def test_a_file_of_another_shape_is_refused_with_what_to_do(tmp_path: Path) -> None:
    camera = camera_file(tmp_path / "camera.toml", THESIS_CAMERA)
    with pytest.raises(CameraError, match=r"a: .*960x540.*640x480.*calibrate at 960x540"):
        open_inputs([pictures(tmp_path / "a", (960, 540))], SETTINGS, camera=camera)


def test_pictures_without_metadata_still_have_a_size(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    for name in ("a.png", "b.pgm"):
        cv2.imwrite(str(tmp_path / "a" / name), np.zeros((240, 320), np.uint8))
    camera = open_inputs([str(tmp_path / "a")], SETTINGS).camera
    assert (camera.width_px, camera.height_px) == (320, 240)
