"""Size, rotation and nominal lens of an input, read before any of its frames is used."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from PIL import Image

from ground_station.errors import CameraError
from ground_station.recording import look as quicktime
from ground_station.recording.look import check_one_lens, look
from ground_station.recording.open import open_input

EXIF, ORIENTATION, MODEL = 0x8769, 0x0112, 0x0110
FOCAL, FILM, PLANE_X, PLANE_UNIT, TAKEN_WIDTH = 0x920A, 0xA405, 0xA20E, 0xA210, 0xA002
KEY = "com.apple.quicktime.camera.focal_length.35mm_equivalent"


def write_picture(path: Path, tags: dict[int, Any], size: tuple[int, int] = (80, 60)) -> None:
    """A picture whose upper left corner is white, with EXIF."""
    image = np.zeros((size[1], size[0]), np.uint8)
    image[:20, :20] = 255
    exif = Image.Exif()
    for tag, value in tags.items():
        (exif if tag == ORIENTATION else exif.get_ifd(EXIF))[tag] = value
    path.parent.mkdir(exist_ok=True)
    Image.fromarray(image).save(path, exif=exif)


def write_video(
    path: Path, rotation_deg: int | None = None, tags: dict[str, str] | None = None
) -> Path:
    """Three pictures of 160x120; `rotation_deg` against the clock, as FFmpeg counts."""
    options = {"movflags": "use_metadata_tags"} if tags else {}
    with av.open(str(path), "w", options=options) as container:
        container.metadata.update(tags or {})
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 160, 120, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 30)
        if rotation_deg is not None:
            stream.set_display_rotation(rotation_deg)
        image = np.zeros((120, 160, 3), np.uint8)
        image[:40, :40] = 255
        for k in range(3):
            frame = av.VideoFrame.from_ndarray(image, format="bgr24")
            frame.pts = k
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


@pytest.mark.parametrize("suffix", ["jpg", "png"])
@pytest.mark.parametrize(("orientation", "turn"), [(1, 0), (3, 180), (6, 90), (8, 270)])
def test_pictures_come_as_stored_and_their_turn_is_told(
    tmp_path: Path, suffix: str, orientation: int, turn: int
) -> None:
    """What is told is the clockwise turn that Pillow makes when it shows the picture."""
    path = tmp_path / "p" / f"a.{suffix}"
    write_picture(path, {ORIENTATION: orientation})
    source = open_input(path.parent)
    (frame,) = source
    assert frame.image.shape == (60, 80) and frame.image[:10, :10].min() > 200
    seen = look(source)
    assert seen.size_px == (80, 60) and seen.display_deg == turn and seen.focal is None
    from PIL import ImageOps

    shown = np.asarray(ImageOps.exif_transpose(Image.open(path)))
    np.testing.assert_allclose(np.rot90(frame.image, -turn // 90).astype(int), shown, atol=3)


@pytest.mark.parametrize("suffix", ["mp4", "mov", "mkv"])
@pytest.mark.parametrize(("against", "turn"), [(None, 0), (90, 270), (-90, 90), (180, 180)])
def test_a_video_comes_as_stored_and_its_rotation_flag_is_told(
    tmp_path: Path, suffix: str, against: int | None, turn: int
) -> None:
    source = open_input(write_video(tmp_path / f"v.{suffix}", against))
    seen = look(source)
    assert seen.size_px == (160, 120) and seen.display_deg == turn
    frame = next(iter(source))
    assert frame.image.shape == (120, 160) and frame.image[:30, :30].min() > 200


@pytest.mark.parametrize("size", [(80, 60), (96, 54), (60, 80)])
def test_an_equivalent_focal_length_is_that_of_the_same_diagonal(
    tmp_path: Path, size: tuple[int, int]
) -> None:
    write_picture(tmp_path / "p" / "a.jpg", {FILM: 26, FOCAL: 4.2}, size)
    focal = look(open_input(tmp_path / "p")).focal
    assert focal is not None and focal.tag == "EXIF FocalLengthIn35mmFilm 26 mm"
    angle = 2 * math.atan(math.hypot(*size) / 2 / focal.px)
    assert angle == pytest.approx(2 * math.atan(math.hypot(36, 24) / 2 / 26))
    assert 0.02 <= focal.sigma <= 0.1


def test_a_focal_length_counts_where_the_pixels_of_its_plane_are_told(tmp_path: Path) -> None:
    """3.04 mm before a sensor 3.68 mm wide: 0.826 of the width, whatever it was scaled to."""
    tags = {FOCAL: 3.04, PLANE_X: 3280 / 0.368, PLANE_UNIT: 3, TAKEN_WIDTH: 3280}
    write_picture(tmp_path / "p" / "a.jpg", tags)
    focal = look(open_input(tmp_path / "p")).focal
    assert focal is not None and focal.px == pytest.approx(80 * 3.04 / 3.68, rel=1e-3)
    assert "FocalLength 3.04 mm" in focal.tag


@pytest.mark.parametrize(
    "tags",
    [{FOCAL: 4.2}, {FILM: 0}, {FILM: 65535}, {FOCAL: 4.2, PLANE_X: 0.0, PLANE_UNIT: 3},
     {FOCAL: 0.0, PLANE_X: 5000.0, PLANE_UNIT: 2}],
)  # fmt: skip
def test_tags_that_tell_no_angle_of_view_are_no_focal_length(
    tmp_path: Path, tags: dict[int, Any]
) -> None:
    write_picture(tmp_path / "p" / "a.jpg", tags)
    assert look(open_input(tmp_path / "p")).focal is None


def test_pictures_of_two_lenses_are_named_and_refused(tmp_path: Path) -> None:
    for name, film in (("a", 26), ("b", 26), ("c", 13)):
        write_picture(tmp_path / "p" / f"{name}.jpg", {FILM: film})
    cv2.imwrite(str(tmp_path / "p" / "aa.png"), np.zeros((60, 80), np.uint8))  # tells nothing
    with pytest.raises(CameraError, match=r"c\.jpg: was taken with another lens .*13 mm.*26 mm"):
        check_one_lens(open_input(tmp_path / "p"))
    (tmp_path / "p" / "c.jpg").unlink()
    check_one_lens(open_input(tmp_path / "p"))


def test_a_damaged_header_is_left_to_who_decodes(tmp_path: Path) -> None:
    path = tmp_path / "p" / "a.jpg"
    write_picture(path, {FILM: 26})
    data = bytearray(path.read_bytes())
    at = data.index(b"Exif\0\0") + 6
    data[at : at + 40] = b"\xff" * 40
    path.write_bytes(bytes(data))
    seen = look(open_input(path.parent))
    assert seen.size_px == (80, 60) and seen.focal is None


def atoms(data: bytes) -> dict[bytes, bytes]:
    """Atoms behind each other, whole, by their kinds."""
    found, at = {}, 0
    while at < len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        found[kind] = data[at : at + size]
        at += size
    return found


def atom(kind: bytes, *parts: bytes) -> bytes:
    content = b"".join(parts)
    return struct.pack(">I4s", 8 + len(content), kind) + content


def in_the_track(path: Path, convert: Callable[[bytes], bytes] = lambda meta: meta) -> None:
    """Moves a file's metadata from the movie into its track, as phones have those of the lens."""
    data = path.read_bytes()
    moov = atoms(data)[b"moov"]
    parts = atoms(moov[8:])
    meta = convert(atoms(parts[b"udta"][8:])[b"meta"])
    track = atom(b"trak", parts[b"trak"][8:], meta)
    path.write_bytes(data.replace(moov, atom(b"moov", parts[b"mvhd"], track)))


def test_a_videos_lens_is_read_from_the_movie_and_from_its_track(tmp_path: Path) -> None:
    path = write_video(tmp_path / "v.mov", tags={KEY: "26", "com.apple.quicktime.model": "X"})
    for move in (False, True):
        if move:
            in_the_track(path)
        assert quicktime.metadata(path)[KEY] == "26"
        focal = look(open_input(path)).focal
        assert focal is not None and focal.tag == f"{KEY} 26 mm"
        assert focal.px == pytest.approx(26 / math.hypot(36, 24) * 200)
        assert focal.sigma > 0.1  # stabilizers and modes crop by an unknown share
    assert look(open_input(write_video(tmp_path / "w.mov"))).focal is None


@pytest.mark.parametrize(
    ("form", "raw"),
    [(21, struct.pack(">i", 24)), (21, b"\x18"), (22, struct.pack(">H", 24)), (67, b"\0\0\0\x18"),
     (23, struct.pack(">f", 24.0)), (24, struct.pack(">d", 24.0))],
)  # fmt: skip
def test_a_number_is_read_in_every_form_and_apples_meta_has_no_version(
    tmp_path: Path, form: int, raw: bytes
) -> None:
    path = write_video(tmp_path / "v.mov", tags={KEY: "26"})

    def as_apple(meta: bytes) -> bytes:
        keys = atom(b"keys", bytes(4), struct.pack(">I", 1), atom(b"mdta", KEY.encode()))
        value = atom(b"data", struct.pack(">II", form, 0), raw)
        return atom(b"meta", keys, atom(b"ilst", atom(struct.pack(">I", 1), value)))

    in_the_track(path, as_apple)
    assert quicktime.metadata(path) == {KEY: 24}


def test_files_that_are_cut_or_no_mp4_have_no_keys(tmp_path: Path) -> None:
    path = write_video(tmp_path / "v.mov", tags={KEY: "26"})
    data = path.read_bytes()
    for end in range(0, len(data), 97):
        path.write_bytes(data[:end])
        assert quicktime.metadata(path) in ({}, {KEY: "26"})
    path.write_bytes(bytes(1000))
    assert quicktime.metadata(path) == {} and quicktime.metadata(tmp_path / "none") == {}
