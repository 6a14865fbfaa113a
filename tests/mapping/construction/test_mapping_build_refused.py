"""What a build cannot use it names in one line, and what was done before that is kept."""

from __future__ import annotations

import resource
import sqlite3

import cv2
import numpy as np
import pytest

from ground_station.errors import InputError, MapError
from ground_station.geometry.camera import Camera
from ground_station.mapping.construction import build, entries
from ground_station.mapping.construction.cache import Cache
from ground_station.mapping.settings import MappingSettings
from ground_station.recording.frames import Frame
from ground_station.recording.open import open_input

CAMERA = Camera(width_px=160, height_px=120, fx_px=120, fy_px=120, cx_px=80, cy_px=60)
SETTINGS = MappingSettings(max_features=100, threads=2)


def _noise(k, size=(120, 160)):
    return np.random.default_rng(k).integers(0, 256, size, dtype=np.uint8)


def _refused(tmp_path, frames, error, words):
    """The cache's figures of a build that fails in one line."""
    with Cache(tmp_path / "cache") as cache:
        with pytest.raises(error, match=words) as caught:
            build.build_map(frames, CAMERA, SETTINGS, tmp_path / "map", cache=cache)
        assert "\n" not in str(caught.value)
        assert not (tmp_path / "map").exists()
    return cache.figures


def test_an_unreadable_image_is_named_and_what_came_before_it_is_kept(tmp_path):
    folder = tmp_path / "images"
    folder.mkdir()
    for k in range(6):
        cv2.imwrite(str(folder / f"{k}.png"), _noise(k))
    whole = (folder / "4.png").read_bytes()
    (folder / "4.png").write_bytes(whole[: len(whole) // 2])
    figures = _refused(tmp_path, open_input(folder), InputError, r"4\.png: not a whole")
    assert (figures.features_found, figures.features_made) == (0, 4)
    (folder / "4.png").write_bytes(whole)
    figures = _refused(tmp_path, open_input(folder), MapError, "no two of the 6 images overlap")
    assert (figures.features_found, figures.features_made) == (4, 2)
    # Nor is anything compared again that was found not to overlap.
    figures = _refused(tmp_path, open_input(folder), MapError, "no two of the 6 images overlap")
    assert (figures.features_made, figures.pairs_found, figures.pairs_made) == (0, 15, 0)


def test_a_picture_of_another_size_is_named_and_what_came_before_it_is_kept(tmp_path):
    def frames():
        for k in range(5):
            yield Frame(k, f"frame-{k}", k, _noise(k, (120, 160) if k < 3 else (120, 176)))

    figures = _refused(
        tmp_path, frames(), MapError, "frame-3: is 176x120 pixels, the camera 160x120"
    )
    assert figures.features_made == 3
    assert _refused(tmp_path, frames(), MapError, "frame-3").features_found == 3


@pytest.mark.parametrize("stage", ["reconstruct", "assemble"])
def test_a_disk_that_is_full_for_the_map_is_one_line_and_the_cache_is_kept(
    built, use_scene, tmp_path, monkeypatch, stage
):
    use_scene(built.scene)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    function = getattr(build, stage)

    def full_from_here(*args):
        # No file can grow any more: what a full disk does, to this process only.
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
        return function(*args)

    monkeypatch.setattr(build, stage, full_from_here)
    try:
        with Cache(tmp_path / "cache") as cache, pytest.raises(MapError) as caught:
            build.build_map(
                built.scene.frames(), built.scene.camera, built.settings, tmp_path / "map",
                cache=cache,
            )  # fmt: skip
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert "\n" not in str(caught.value) and str(tmp_path) in str(caught.value)
    assert not list(tmp_path.glob("map*"))
    with sqlite3.connect(tmp_path / "cache" / "mapping-1.sqlite") as db:
        kinds = dict(db.execute("SELECT kind, count(*) FROM entries GROUP BY kind"))
    db.close()
    images = len(built.scene.wTc)
    assert kinds == {entries.FEATURES: images, entries.PAIR: images * (images - 1) // 2}
