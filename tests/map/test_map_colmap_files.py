"""A COLMAP model whose files are cut or contradict each other never reaches COLMAP's reader."""

from __future__ import annotations

import shutil
import struct
from pathlib import Path

import pytest
import two_images

from ground_station.errors import MapError
from ground_station.map import colmap, colmap_files

FILES = ("cameras.bin", "rigs.bin", "images.bin", "frames.bin", "points3D.bin")


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Path:
    """Two images that see one point."""
    return two_images.write(tmp_path_factory.mktemp("model") / "sparse")


@pytest.fixture
def copy(written: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(written, tmp_path / "sparse"))


def put(path: Path, at: int, form: str, *values: float) -> None:
    data = bytearray(path.read_bytes())
    struct.pack_into(form, data, at, *values)
    path.write_bytes(bytes(data))


def test_what_colmap_writes_is_taken(written: Path) -> None:
    colmap_files.check(written)
    assert colmap.to_arrays(colmap.read(written)).names == ["a.png", "b.png"]


@pytest.mark.parametrize("name", FILES)
def test_a_file_cut_anywhere_or_longer_is_refused_by_its_name(copy: Path, name: str) -> None:
    whole = (copy / name).read_bytes()
    for data in (*(whole[:size] for size in range(len(whole))), whole + b"\0"):
        (copy / name).write_bytes(data)
        with pytest.raises(MapError, match=rf"^[^\n]*{name}: not a COLMAP model[^\n]*$"):
            colmap.read(copy)
    (copy / name).unlink()
    with pytest.raises(MapError, match=name):
        colmap.read(copy)


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("count", [0, 3, 1 << 40, (1 << 64) - 1])
def test_a_count_that_is_not_so_is_refused(copy: Path, name: str, count: int) -> None:
    put(copy / name, 0, "<Q", count)
    with pytest.raises(MapError, match=r"^[^\n]+$"):
        colmap.read(copy)


@pytest.mark.parametrize(
    ("name", "at", "form", "value", "words"),
    [
        ("cameras.bin", 8, "<I", 2, "no camera 1"),
        ("cameras.bin", 12, "<i", 4, "PINHOLE"),
        ("cameras.bin", 16, "<Q", 1 << 40, "cannot be"),
        ("cameras.bin", 32, "<d", float("nan"), "cannot be"),
        ("rigs.bin", 12, "<I", 0xFFFFFFFF, "cut"),
        ("rigs.bin", 20, "<I", 9, "no camera of the model"),
        ("images.bin", 12, "<d", float("nan"), "a pose in it is none"),
        ("images.bin", 12, "<d", 5.0, "a pose in it is none"),
        ("images.bin", 68, "<I", 9, "a camera that is not there"),
        ("images.bin", 78, "<Q", 1 << 60, "cut, or claims more"),
        ("images.bin", 86, "<d", float("inf"), "not finite"),
        ("images.bin", 102, "<Q", 6, "contradict"),
        ("frames.bin", 12, "<I", 9, "a rig that is not there"),
        ("frames.bin", 84, "<Q", 2, "does not belong to it"),
        ("points3D.bin", 16, "<d", float("nan"), "not finite"),
        ("points3D.bin", 59, "<I", 7, "contradict"),
        ("points3D.bin", 63, "<I", 7, "contradict"),
        ("points3D.bin", 51, "<Q", 1 << 60, "cut, or claims more"),
    ],
)  # fmt: skip
def test_what_contradicts_itself_is_refused(
    copy: Path, name: str, at: int, form: str, value: float, words: str
) -> None:
    put(copy / name, at, form, value)
    with pytest.raises(MapError, match=words) as error:
        colmap.read(copy)
    assert "\n" not in str(error.value)


def test_the_shipped_map_is_taken() -> None:
    colmap_files.check(Path(__file__).parents[2] / "maps" / "atrium" / "sparse")
