"""`blimp map`: help at once, one line for what is wrong, numbers for what was measured."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hand_made import run

from ground_station.cli import main
from ground_station.commands import maps
from ground_station.errors import CameraError, InputError, MapError
from pi_firmware.wire.errors import ConfigError

ROOT = Path(__file__).parents[2]


def test_info_says_what_a_map_holds(built, tmp_path, capsys):
    assert run(maps, "info", built.folder, "--json", tmp_path / "info.json") == 0
    document = json.loads((tmp_path / "info.json").read_text())
    assert document["images"] == 16 and document["landmarks"] == len(built.map.landmarks)
    assert document["frame"] == "sfm" and document["registration"] == "none"
    assert document["size_mb"] > 0 and 0 < document["reprojection_px"] < 1
    printed = capsys.readouterr().out
    for word in ("landmarks", "mean_track", "features", "camera", "units"):
        assert word in printed


def _images(folder: Path, count: int, size=(480, 640)) -> Path:
    import cv2
    import numpy as np

    folder.mkdir(parents=True)
    rng = np.random.default_rng(0)
    for k in range(count):
        cv2.imwrite(str(folder / f"{k:03d}.png"), rng.integers(0, 256, size, dtype=np.uint8))
    return folder


@pytest.fixture
def camera_file(tmp_path):
    path = tmp_path / "camera.toml"
    path.write_text(
        "width_px = 640\nheight_px = 480\nfx_px = 500.0\nfy_px = 500.0\ncx_px = 320.0\n"
        "cy_px = 240.0\n"
    )
    return path


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        (["empty"], InputError, "empty"),
        (["one", "--camera", "camera.toml"], InputError, "the input has 1"),
        (["wide", "--camera", "camera.toml"], CameraError, "320x200, the .*another shape"),
        (["tall", "--camera", "camera.toml"], CameraError, "240x320, the .*turned by a quarter"),
        (["two", "--camera", "camera.toml", "--max-images", "1"], ConfigError, "max_images"),
        (["two", "--camera", "camera.toml"], MapError, "no two of the 2 images overlap"),
        (["two", "--camera", "camera.toml", "--range", "5"], InputError, "'5'"),
        (["two", "b/two", "--camera", "camera.toml"], InputError, "two inputs are named 'two'"),
    ],
)
def test_bad_input_gets_one_line(tmp_path, monkeypatch, camera_file, arguments, error, words):
    _images(tmp_path / "empty", 0)
    _images(tmp_path / "one", 1)
    _images(tmp_path / "two", 2)
    _images(tmp_path / "b" / "two", 2)
    _images(tmp_path / "wide", 2, (200, 320))
    _images(tmp_path / "tall", 2, (320, 240))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(error, match=words) as caught:
        run(maps, "build", *arguments, "--out", "map")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "map").exists() and not (tmp_path / "map.part").exists()


def test_keyframes_of_long_inputs_are_taken_and_it_is_said(
    tmp_path, monkeypatch, camera_file, capsys
):
    _images(tmp_path / "many", 9, (480, 640))
    settings = tmp_path / "mapping.toml"
    settings.write_text("max_images = 4\nmax_features = 50\n")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(MapError, match="no two of the 6 images"):  # the flag goes before the file
        run(maps, "build", "many", "--camera", camera_file, "--settings", settings, "--out", "map",
            "--max-images", 6)  # fmt: skip
    capsys.readouterr()
    # Noise: none shows what another does, so all nine are due, and they are thinned.
    with pytest.raises(MapError, match="no two of the 4 images"):
        run(maps, "build", "many", "--camera", camera_file, "--settings", settings, "--out", "map")
    said = capsys.readouterr().out
    assert "9 frames; 4 keyframes are used of 9 that were due" in said and "max_images is 4" in said
    with pytest.raises(MapError, match="no two of the 9 images"):  # a step is meant as it stands
        run(maps, "build", "many", "--camera", camera_file, "--settings", settings,
            "--out", "map", "--range", "::1")  # fmt: skip


def test_a_build_without_a_camera_says_which_lens_it_starts_with(tmp_path, monkeypatch, capsys):
    _images(tmp_path / "two", 2)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(MapError, match="no two of the 2 images overlap"):
        run(maps, "build", "two", "--out", "map")
    assert "a focal length of 473 px is guessed" in capsys.readouterr().out


def test_a_build_ends_with_a_verdict_a_picture_and_the_next_command(
    built, tmp_path, monkeypatch, capsys
):
    """A build that has made this map: what is printed of it, drawn and written."""
    import shutil

    from ground_station.mapping.construction import build

    _images(tmp_path / "two", 2)
    shutil.copytree(built.folder, tmp_path / "map")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(build, "build_map", lambda *_, **__: built.map)
    assert main(["map", "build", "two", "--out", "map", "--json", "b.json"]) == 0
    _, cached, *lines = capsys.readouterr().out.splitlines()  # after the guessed lens
    assert "features of 0 of 0 images" in cached
    notes = built.map.info.built["notes"]
    assert lines[: len(notes)] == notes
    lines = lines[len(notes) :]
    assert lines[0] == "WHOLE: all 16 images stand in this map, in one piece"
    assert lines[-2:] == [
        "picture: map/map.png",
        "next: blimp map register map --page --plan floorplan.png"
        "    (its scale and its place in the building)",
    ]
    assert len(lines) <= 6
    assert (tmp_path / "map" / "map.png").read_bytes()[:4] == b"\x89PNG"
    document = json.loads((tmp_path / "b.json").read_text())
    assert document["verdict"] == "whole" and document["said"] == lines[:-2]
    assert document["landmarks"] == len(built.map.landmarks)  # all the keys as before
