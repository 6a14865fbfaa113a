"""Folders of images, and ranges."""

from __future__ import annotations

import struct
import subprocess
import sys
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ground_station.errors import InputError
from ground_station.recording.frames import FrameRange
from ground_station.recording.open import open_input, parse_range


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Twelve images whose brightness is their number, beside files that are no images."""
    path = tmp_path / "frames"
    path.mkdir()
    for k in range(12):
        suffix = ("png", "jpg", "JPG")[k % 3]
        cv2.imwrite(str(path / f"im-{k:03d}.{suffix}"), np.full((24, 32, 3), 10 * k, np.uint8))
    (path / "notes.txt").write_text("no image")
    return path


def test_images_come_sorted_by_name_at_the_rate_asked_for(folder: Path) -> None:
    source = open_input(folder, rate_hz=10)
    frames = list(source)
    assert [f.index for f in frames] == list(range(12))
    assert [f.name for f in frames] == sorted(f.name for f in frames)
    assert [f.time_ns for f in frames] == [k * 100_000_000 for k in range(12)]
    assert [round(float(f.image.mean()) / 10) for f in frames] == list(range(12))
    assert frames[0].image.shape == (24, 32) and frames[0].image.dtype == np.uint8
    assert source.count() == 12 and source.camera is None and source.notes == []


def test_a_range_changes_neither_times_nor_indices(folder: Path) -> None:
    whole = {f.name: f for f in open_input(folder)}
    source = open_input(folder, frame_range=parse_range("2:11:4"))
    part = list(source)
    assert [f.index for f in part] == [2, 6, 10] and source.count() == 3
    for frame in part:
        assert frame.time_ns == whole[frame.name].time_ns == round(frame.index * 1e9 / 30)


def of_names(folder: Path, names: list[str]) -> Path:
    """A folder of small images of these names."""
    folder.mkdir()
    for name in names:
        cv2.imwrite(str(folder / name), np.zeros((4, 4), np.uint8))
    return folder


def test_numbers_in_names_are_counted(tmp_path: Path) -> None:
    names = ["a1.png", "a2.png", "a02.png", "a10.png", "a10b.png", "b1.png"]
    folder = of_names(tmp_path / "frames", names)
    assert [f.name for f in open_input(folder)] == ["a1.png", "a02.png", *names[1:2], *names[3:]]


@pytest.mark.parametrize(
    ("names", "times_ns"),
    [
        (["9.5000.png", "10.250.png"], [9_500_000_000, 10_250_000_000]),
        (["1305031452.791720.png", "1305031453.123.png"],
         [1305031452791720000, 1305031453123000000]),
        (["1403636579763555584.png", "1403636579813555456.png"], None),
        (["1403636579763555.png", "1403636579813555.png"], None),
        (["1403636579763.png", "1403636579813.png"], None),
    ],
)  # fmt: skip
def test_images_named_by_their_times_have_those(
    tmp_path: Path, names: list[str], times_ns: list[int] | None
) -> None:
    folder = of_names(tmp_path / "frames", names)
    source = open_input(folder)
    if times_ns is None:  # of whole numbers since 1970
        times_ns = [int(Path(name).stem.ljust(19, "0")) for name in names]
    assert [(f.name, f.time_ns) for f in source] == list(zip(names, times_ns, strict=True))
    assert source.notes == [f"{folder}: its images are named by their times, and have those"]
    given = open_input(folder, rate_hz=10.0)
    assert [(f.name, f.time_ns) for f in given] == list(zip(names, [0, 100_000_000], strict=True))
    assert given.notes == []


@pytest.mark.parametrize(
    "names",
    [
        ["1.25.png", "1.26.png"],  # sections, not seconds
        ["0000000000001.png", "0000000000002.png"],
        ["1305031452.7917.png", "1305031452.791700.png"],  # the same time twice
        ["1305031452.791720.png", "cover.png"],
        ["9999999999999999998.png", "9999999999999999999.png"],  # beyond 64 bits
    ],
)
def test_other_names_are_no_times(tmp_path: Path, names: list[str]) -> None:
    source = open_input(of_names(tmp_path / "frames", names))
    assert [f.time_ns for f in source] == [0, round(1e9 / 30)] and source.notes == []


def test_pictures_of_two_kinds_are_refused(tmp_path: Path) -> None:
    names = [f"frame-{k:02d}.{kind}.png" for k in (1, 2) for kind in ("color", "depth")]
    folder = of_names(tmp_path / "frames", names)
    with pytest.raises(InputError) as refused:
        open_input(folder)
    assert "both frame-#.color.png and frame-#.depth.png of each number" in str(refused.value)
    (folder / names[1]).unlink()
    assert len(list(open_input(folder))) == 3  # other numbers: pictures that two people took


def test_iterating_twice_starts_anew(folder: Path) -> None:
    source = open_input(folder)
    assert [f.name for f in source] == [f.name for f in source]


def test_an_unreadable_image_is_named_when_its_turn_comes(folder: Path) -> None:
    (folder / "im-005.JPG").write_bytes(b"\xff\xd8 this is no picture")
    frames = iter(open_input(folder))
    for _ in range(5):
        next(frames)
    with pytest.raises(InputError, match=r"^[^\n]*im-005\.JPG: not a whole, readable image$"):
        next(frames)


def test_a_cut_jpeg_is_refused_rather_than_filled_with_grey(folder: Path, tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (240, 320), dtype=np.uint8)
    whole = cv2.imencode(".jpg", noise)[1].tobytes()
    path = tmp_path / "one"
    path.mkdir()
    (path / "a.jpg").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"a\.jpg"):
        list(open_input(path))
    (path / "a.jpg").write_bytes(whole + b"\0" * 10)  # cameras pad their files
    assert len(list(open_input(path))) == 1


@pytest.mark.parametrize(
    "content", [b"", b"\x89PNG\r\n\x1a\n", b"BM\xff\xff\xff\x7f" + b"\xff" * 60]
)
def test_files_that_only_look_like_images_are_named(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "bad.png").write_bytes(content)
    with pytest.raises(InputError, match=r"bad\.png"):
        list(open_input(tmp_path))


def test_a_small_file_of_many_pixels_is_refused(tmp_path: Path) -> None:
    side = 14_000  # a row is its filter's byte and its pixels

    def part(name: bytes, data: bytes) -> bytes:
        sum_ = zlib.crc32(name + data)
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", sum_)

    rows = zlib.compress(bytes(side * (side + 1)), 1)
    head = struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0)
    png = b"\x89PNG\r\n\x1a\n" + part(b"IHDR", head) + part(b"IDAT", rows) + part(b"IEND", b"")
    (tmp_path / "a.png").write_bytes(png)
    # OpenCV takes the limit when it is imported, which in this process was long ago.
    code = f"""
from pathlib import Path
from ground_station.errors import InputError
from ground_station.recording.folder import read_grey
try:
    read_grey(Path({str(tmp_path / "a.png")!r}))
except InputError as error:
    assert "a.png: not a whole, readable image" in str(error)
else:
    raise SystemExit("it was read")
"""
    subprocess.run([sys.executable, "-c", code], timeout=60, check=True)


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.png").symlink_to("/dev/zero")
    with pytest.raises(InputError, match=r"a\.png: not a file"):
        list(open_input(tmp_path))


def test_images_of_another_size_are_refused(folder: Path) -> None:
    cv2.imwrite(str(folder / "im-009.png"), np.zeros((48, 32), np.uint8))
    with pytest.raises(InputError, match=r"im-009\.png: 32x48 px, but .* 32x24 px"):
        list(open_input(folder))


def test_a_folder_without_images_and_a_missing_one_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no images in this folder"):
        open_input(tmp_path)
    with pytest.raises(InputError, match=r"nowhere: No such file or directory"):
        open_input(tmp_path / "nowhere")


def test_a_range_past_the_last_image_is_refused(folder: Path) -> None:
    with pytest.raises(InputError, match="the range 50:60 holds none of its 12 images"):
        open_input(folder, frame_range=FrameRange(50, 60))


@pytest.mark.parametrize("rate_hz", [0, -1, float("nan"), float("inf"), 1e9])
def test_an_impossible_rate_is_refused(folder: Path, rate_hz: float) -> None:
    with pytest.raises(InputError, match=r"allowed: 0\.001 to 10000 Hz"):
        open_input(folder, rate_hz=rate_hz)


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 60), st.integers(1, 60), st.integers(1, 9), st.integers(0, 80))
def test_a_range_takes_what_a_slice_takes(start: int, length: int, step: int, n: int) -> None:
    wanted = parse_range(f"{start}:{start + length}:{step}")
    expected = list(range(n))[start : start + length : step]
    assert [k for k in range(n) if k in wanted] == expected
    assert wanted.count(n) == len(expected)
    assert parse_range(str(wanted)) == wanted


def test_ends_of_a_range_may_be_left_out() -> None:
    assert parse_range("5:") == FrameRange(5, None, 1)
    assert parse_range(":7") == FrameRange(0, 7, 1)
    assert parse_range("::3") == FrameRange(0, None, 3)
    assert not FrameRange(5, None).is_past(10**9) and FrameRange(0, 7).is_past(7)


BAD = [
    *("", "5", "a:b", "5:5", "7:3", "-1:4", "0:10:0", "0:10:-1", "0:1:2:3", "1.5:4", "0:9\n9"),
    *("٣:٤", "²:3", "1" * 30_000 + ":", "\n"),
]


@pytest.mark.parametrize("text", BAD, ids=range(len(BAD)))
def test_a_bad_range_is_told_in_one_short_line(text: str) -> None:
    with pytest.raises(InputError, match=r"^the range [^\n]{1,150}$") as error:
        parse_range(text)
    assert "A:B" in str(error.value)
