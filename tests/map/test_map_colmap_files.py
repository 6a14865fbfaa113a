"""A COLMAP model whose files are cut or contradict each other never comes to this process."""

from __future__ import annotations

import os
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


def test_what_colmap_writes_is_taken(written: Path) -> None:
    assert colmap.to_arrays(colmap.read(written)).names == ["a.png", "b.png"]


@pytest.mark.parametrize("name", FILES)
def test_a_file_cut_or_longer_or_missing_is_refused(copy: Path, name: str) -> None:
    whole = (copy / name).read_bytes()
    for data in (whole[:7], whole[:-1], whole + b"\0", None):
        (copy / name).unlink()
        if data is not None:
            (copy / name).write_bytes(data)
        with pytest.raises(MapError, match=r"^[^\n]*: not a COLMAP model: [^\n]+$"):
            colmap.read(copy)
        (copy / name).write_bytes(whole)


NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("name", "at", "form", "value", "words"),
    [
        ("cameras.bin", 8, "<I", 2, "Camera 1 from rig 1 not found"),
        ("cameras.bin", 12, "<i", 4, "cameras.bin is cut, or holds other things"),
        ("cameras.bin", 16, "<Q", 1 << 40, "camera 1 cannot be"),
        ("cameras.bin", 32, "<d", NAN, "camera 1 cannot be"),
        ("rigs.bin", 12, "<I", 0xFFFFFFFF, "rig"),
        ("images.bin", 0, "<Q", 3, "not a COLMAP model"),
        ("frames.bin", 16, "<d", NAN, "the pose of image 1 is none"),
        ("images.bin", 68, "<I", 9, "Image 1 does not exist"),
        ("images.bin", 78, "<Q", 1 << 60, "not a COLMAP model"),
        ("images.bin", 86, "<d", INF, "a pixel of image 1 is not finite"),
        ("images.bin", 102, "<Q", 6, "point3D_id"),
        ("frames.bin", 12, "<I", 9, "Rig with ID 9"),
        ("points3D.bin", 0, "<Q", 0, "contradict each other"),
        ("points3D.bin", 16, "<d", NAN, "a point is not finite"),
        ("points3D.bin", 59, "<I", 7, "Image with ID 7"),
    ],
)
def test_what_contradicts_itself_is_refused(
    copy: Path, name: str, at: int, form: str, value: float, words: str
) -> None:
    data = bytearray((copy / name).read_bytes())
    struct.pack_into(form, data, at, value)
    (copy / name).write_bytes(bytes(data))
    with pytest.raises(MapError, match=words) as caught:
        colmap.read(copy)
    assert "\n" not in str(caught.value)


def test_a_count_that_takes_for_ever_is_refused_when_its_time_is_over(
    copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(colmap_files, "_SECONDS", 1)
    data = bytearray((copy / "points3D.bin").read_bytes())
    struct.pack_into("<Q", data, 51, 1 << 60)  # of the observations of its one point
    (copy / "points3D.bin").write_bytes(bytes(data))
    with pytest.raises(MapError, match=r"^[^\n]*: not a COLMAP model: [^\n]+$"):
        colmap.read(copy)


def test_a_pipe_in_a_models_folder_is_refused_and_not_waited_for(copy: Path) -> None:
    (copy / "images.bin").unlink()
    os.mkfifo(copy / "images.bin")
    with pytest.raises(MapError, match=r"^[^\n]*images.bin: neither a file nor a folder[^\n]*$"):
        colmap.read(copy)


def test_a_maps_model_has_a_lens_that_a_map_can_have(copy: Path) -> None:
    model = colmap.reread(copy)
    model.cameras[1].model = colmap.pycolmap.CameraModelId.FOV
    model.cameras[1].params = [500.0, 500.0, 320.0, 240.0, 0.1]
    model.write(copy)
    with pytest.raises(MapError, match=r"^[^\n]*model FOV; what can be taken over is [^\n]*$"):
        colmap.read(copy)


def test_the_shipped_map_is_taken() -> None:
    colmap_files.check(Path(__file__).parents[2] / "maps" / "atrium" / "sparse")
