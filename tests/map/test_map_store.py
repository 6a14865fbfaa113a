"""Maps survive the disk, and damaged ones are refused in one line that names the file."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from ground_station.errors import MapError
from ground_station.map import store


def test_a_map_comes_back_as_it_was_written(built, tmp_path):
    info = dataclasses.replace(built.map.info, built={"settings": {"quantise": False}})
    store.save_tables(tmp_path, dataclasses.replace(built.map, info=info))
    loaded = store.load(tmp_path)
    assert vars(loaded.info) == vars(info)
    for part in ("landmarks", "keyframes"):
        for name, value in vars(getattr(built.map, part)).items():
            again = getattr(getattr(loaded, part), name)
            if isinstance(value, list):
                assert again == value
            elif name == "descriptor":  # renormalised when read
                assert np.allclose(again, value, atol=1e-6)
            else:
                assert np.array_equal(again, value) and again.dtype == value.dtype


@pytest.mark.parametrize(
    "said", [0.0, -1.0, float("nan"), float("inf"), "half a pixel", True, None]
)
def test_a_noise_that_is_no_length_is_not_known(built, said):
    info = built.map.info
    assert info.noise_px == info.built["noise_px"] > 0
    assert dataclasses.replace(info, built={"noise_px": said}).noise_px is None


def test_the_map_can_be_read_by_others_than_its_owner(built):
    for path in built.folder.iterdir():
        if path.is_file():
            assert path.stat().st_mode & 0o044 == (built.folder / "map.toml").stat().st_mode & 0o044


def _truncate(path):
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])


def _edit(name, change):
    def edit(path):
        arrays = load_file(path)
        with store.safe_open(path, framework="numpy") as file:
            metadata = file.metadata()
        arrays[name] = change(arrays[name].copy())
        save_file(arrays, path, metadata)

    return edit


def _swap(old, new=None, value=None):
    """Takes an array out, or puts it under another name, with one value in it if given."""

    def edit(path):
        arrays = load_file(path)
        array = arrays.pop(old)
        if new is not None:
            array = array if value is None else array.astype(np.float32)
            array.flat[-1] = array.flat[-1] if value is None else value
            arrays[new] = array
        save_file(arrays, path)

    return edit


def _dimension(value):
    def edit(path):
        text, count = re.subn(r"dimension = \d+", f"dimension = {value}", path.read_text())
        assert count == 1
        path.write_text(text)

    return edit


def _nan(array):
    array.flat[0] = np.nan
    return array


def _huge(array):
    array.flat[0] = 10**6
    return array


@pytest.mark.parametrize(
    ("file", "damage", "words"),
    [
        ("landmarks.safetensors", lambda p: p.unlink(), "landmarks.safetensors"),
        ("landmarks.safetensors", _truncate, "landmarks.safetensors"),
        ("landmarks.safetensors", lambda p: p.write_bytes(b""), "landmarks.safetensors"),
        ("landmarks.safetensors", lambda p: p.write_bytes(b"\xff" * 4096), "landmarks"),
        ("landmarks.safetensors", _edit("position_m", _nan), "'position_m'.*not finite"),
        ("landmarks.safetensors", _edit("covariance_m2", _nan), "'covariance_m2'.*not finite"),
        ("landmarks.safetensors", _edit("position_m", lambda a: a.astype(np.float32)), "float64"),
        ("landmarks.safetensors", _edit("position_m", lambda a: a[:, :2]), r"\(N, 3\)"),
        ("landmarks.safetensors", _edit("spread", lambda a: a[:-1]), "differ in length"),
        ("landmarks.safetensors", _edit("descriptor_u8", lambda a: a[:, :5]), "descriptors are"),
        ("landmarks.safetensors", _swap("descriptor_u8"), "holds no descriptors"),
        ("landmarks.safetensors", _swap("descriptor_u8", "descriptor", np.nan), "not finite"),
        ("landmarks.safetensors", _swap("descriptor_u8", "descriptor_i8"), "must be int8"),
        ("landmarks.safetensors", _edit("descriptor_u8", lambda a: a[1:]), "descriptors are"),
        ("landmarks.safetensors", _edit("descriptor_u8", lambda a: a.ravel()), "descriptors are"),
        ("keyframes.safetensors", _truncate, "keyframes.safetensors"),
        ("keyframes.safetensors", _edit("wTc", _nan), "'wTc'.*not finite"),
        ("keyframes.safetensors", _edit("landmark", _huge), "do not fit each other"),
        ("keyframes.safetensors", _edit("offset", lambda a: a[::-1]), "do not fit each other"),
        ("keyframes.safetensors", _edit("time_ns", lambda a: a[1:]), "do not fit each other"),
        ("map.toml", lambda p: p.unlink(), "map.toml"),
        ("map.toml", _dimension("inf"), "map.toml.*not of its kind"),
        ("map.toml", _dimension("nan"), "map.toml.*not of its kind"),
        ("map.toml", _dimension("[]"), "map.toml.*not of its kind"),
        ("map.toml", lambda p: p.write_bytes(b"\x00\xfe not toml"), "not a text file"),
        ("map.toml", lambda p: p.write_text("format = 1\n"), "'features' and 'camera'"),
        ("map.toml", lambda p: p.write_text(p.read_text().replace("fx_px", "fxx")), "'fxx'"),
        ("map.toml", lambda p: p.write_text(p.read_text().replace("format = 1", "format = 99")),
         "format 99; this program reads 1"),
        ("map.toml", lambda p: p.write_text(p.read_text().replace("format = 1", "format = 2")),
         "a compressed map, .*; take the map that it was made of, or build it again"),
    ],
)  # fmt: skip
def test_a_damaged_map_is_refused_in_one_line(target, file, damage, words):
    damage(target / file)
    with pytest.raises(MapError, match=words) as caught:
        store.load(target)
    assert "\n" not in str(caught.value)


def test_a_map_of_other_features_is_refused_by_name(built):
    info = built.map.info
    store.check_features(info, "scene", info.features_sha256)
    for name, sha in (("rootsift", info.features_sha256), ("scene", "f" * 64)):
        with pytest.raises(MapError, match=f"'scene'.*'{name}'"):
            store.check_features(info, name, sha)


def test_there_is_no_such_map(tmp_path):
    with pytest.raises(MapError, match=r"a folder without a map .*; blimp map build INPUT --out"):
        store.load(tmp_path)
    with pytest.raises(MapError, match="no such map; blimp map build INPUT --out"):
        store.load(tmp_path / "nowhere")
