"""Video files and raw H.264 streams."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from numbered_video import FRAMES, HEIGHT, WIDTH, encode, number_in, picture

from ground_station.errors import InputError
from ground_station.recording import video
from ground_station.recording.h264 import grey
from ground_station.recording.open import open_input, parse_range
from pi_firmware.wire import annexb

STREAMS = Path(__file__).parents[3] / "shared" / "data" / "streams"
needs_streams = pytest.mark.skipif(not STREAMS.is_dir(), reason="../shared/data is not there")


def write_video(
    path: Path,
    times_ms: list[int],
    options: dict[str, str] | None = None,
    container_options: dict[str, str] | None = None,
) -> None:
    """A container whose frame k shows k and is at times_ms[k]."""
    with av.open(str(path), "w", options=container_options or {}) as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "10", **(options or {})})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 1000)
        for k, ms in enumerate(times_ms):
            frame = av.VideoFrame.from_ndarray(np.dstack([picture(k)] * 3), format="bgr24")
            frame.pts, frame.time_base = ms, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
def test_a_video_keeps_its_own_times_also_with_b_frames(tmp_path: Path, suffix: str) -> None:
    times_ms = [0, 40, 70, 170, 171, 300, 333, 366, 400, 1000]
    path = tmp_path / f"video.{suffix}"
    write_video(path, times_ms, {"x264-params": "bframes=3:b-adapt=0"})
    source = open_input(path)
    frames = list(source)
    assert [f.time_ns for f in frames] == [ms * 1_000_000 for ms in times_ms]
    assert [number_in(f.image) for f in frames] == list(range(10))
    assert [f.name for f in frames[:2]] == ["frame-000000", "frame-000001"]
    assert source.count() in (None, 10) and source.notes == []


def test_a_video_and_the_images_it_was_made_of_agree_in_grey(tmp_path: Path) -> None:
    write_video(tmp_path / "v.mp4", [0, 33, 66])
    (tmp_path / "images").mkdir()
    for k in range(3):
        cv2.imwrite(str(tmp_path / "images" / f"{k}.png"), picture(k))
    video, images = open_input(tmp_path / "v.mp4"), open_input(tmp_path / "images")
    for a, b in zip(video, images, strict=True):
        difference = a.image.astype(int) - b.image
        assert abs(difference.mean()) < 1.0 and np.percentile(np.abs(difference), 95) <= 2
        assert a.image.min() <= 2 and a.image.max() >= 253  # the whole range is used


@pytest.mark.parametrize(
    "layout", ["yuv420p", "yuvj420p", "yuv444p", "gray", "rgb24", "yuv420p10le"]
)
def test_grey_is_the_converters_within_a_level_for_every_layout(layout: str) -> None:
    ramp = np.tile(np.arange(256, dtype=np.uint8), (64, 1))
    frame = av.VideoFrame.from_ndarray(np.dstack([ramp] * 3), format="rgb24")
    frame = frame.reformat(format=layout)
    ours = grey(frame).astype(int)
    assert ours.shape == (64, 256) and ours.dtype == int
    assert np.abs(ours - frame.to_ndarray(format="gray")).max() <= 1
    assert np.abs(ours - ramp).max() <= 2


def test_a_padded_luma_plane_is_cropped() -> None:
    ramp = np.tile(np.arange(102, dtype=np.uint8), (50, 1))  # 102 is no multiple of a cache line
    frame = av.VideoFrame.from_ndarray(np.dstack([ramp] * 3), format="rgb24")
    image = grey(frame.reformat(format="yuv420p"))
    assert image.shape == (50, 102) and np.abs(image.astype(int) - ramp).max() <= 2


def test_a_range_of_a_video_keeps_index_and_time(tmp_path: Path) -> None:
    write_video(tmp_path / "v.mp4", [k * 50 for k in range(12)])
    frames = list(open_input(tmp_path / "v.mp4", frame_range=parse_range("3:10:3")))
    assert [(f.index, f.time_ns, number_in(f.image)) for f in frames] == [
        (k, k * 50_000_000, k) for k in (3, 6, 9)
    ]
    source = open_input(tmp_path / "v.mp4", frame_range=parse_range("100:"))
    with pytest.raises(InputError, match="no video frames in the range 100:"):
        list(source)


def test_what_an_edit_list_leaves_out_is_neither_shown_nor_a_cut(tmp_path: Path) -> None:
    """Times before 0 are written as an edit list that begins later, as players and phones do."""
    path = tmp_path / "v.mp4"
    write_video(path, [-66 + 33 * k for k in range(12)], {"x264-params": "bframes=3:b-adapt=0"})
    source = open_input(path)
    frames = list(source)
    assert [number_in(f.image) for f in frames] == list(range(2, 12))
    assert [f.time_ns for f in frames] == [33_000_000 * k for k in range(10)]
    assert source.notes == []


def test_an_avi_with_b_frames_has_times_in_the_order_of_its_pictures(tmp_path: Path) -> None:
    """AVI keeps times in the order of decoding: read as they stand, they jump back and forth."""
    path = tmp_path / "v.avi"
    write_video(path, [33 * k for k in range(30)], {"x264-params": "bframes=3:b-adapt=0"})
    frames = list(open_input(path))
    assert [number_in(f.image) for f in frames] == list(range(30))
    steps_ms = np.diff([f.time_ns for f in frames]) / 1e6
    assert set(steps_ms[:-1]) == {33.0} and 0 < steps_ms[-1] <= 33


def test_a_stream_whose_first_time_is_late_keeps_it(tmp_path: Path) -> None:
    write_video(tmp_path / "v.ts", [1000 + 40 * k for k in range(6)])
    times = [f.time_ns for f in open_input(tmp_path / "v.ts")]
    assert list(np.diff(times)) == [40_000_000] * 5 and times[0] >= 1_000_000_000


@dataclass
class Stamped:
    """What the fixing of times reads of a picture."""

    pts: int | None
    time_base: Fraction = Fraction(1, 1000)


def repaired(stamps_ms: list[int | None]) -> tuple[list[float], list[str]]:
    """Times, milliseconds, and notes of pictures with these stamps, at 25 Hz where none has one."""
    repair = video._StampRepair(25.0, "matroska")
    times = [ns / 1e6 for ns, _ in repair.times(iter([Stamped(ms) for ms in stamps_ms]))]
    return times, list(repair.notes())


@pytest.mark.parametrize(
    ("stamps_ms", "times_ms", "note"),
    [
        ([0, 33, 66, 500, 520], [0, 33, 66, 500, 520], None),
        ([0, 40, 40, 80, 120], [0, 40, 60, 80, 120], "1 frames not later than those before them"),
        ([0, 40, 80, 30, 120], [0, 40, 80, 100, 120], "1 frames not later than those before them"),
        ([0, 40, None, 80], [0, 40, 60, 80], "1 frames without a time, put after"),
        ([None, None, None], [0, 40, 80], "3 frames without a time, taken at 25 Hz"),
        ([7, 7, 7], [7, 27, 47], "2 frames not later than those before them"),
    ],
)
def test_times_that_are_missing_or_doubled_are_put_between_and_said(
    stamps_ms: list[int | None], times_ms: list[float], note: str | None
) -> None:
    """A frame that is not later than the one before would be refused by who localizes it."""
    times, notes = repaired(stamps_ms)
    assert times == times_ms
    assert [n[: len(note or "")] for n in notes] == ([note] if note else [])


def test_a_cut_video_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    path = tmp_path / "v.mkv"
    write_video(path, [k * 33 for k in range(30)], {"x264-params": "keyint=5"})
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    frames = list(open_input(path))
    assert 3 < len(frames) < 30
    assert [number_in(f.image) for f in frames] == list(range(len(frames)))


def test_a_cut_video_whose_header_counts_frames_says_so(tmp_path: Path) -> None:
    path = tmp_path / "v.mp4"
    write_video(
        path, [k * 33 for k in range(30)], {"x264-params": "keyint=5"}, {"movflags": "+faststart"}
    )
    whole = open_input(path)
    assert len(list(whole)) == whole.count() == 30 and whole.notes == []
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    source = open_input(path)
    frames = list(source)
    assert 3 < len(frames) < 30 and len(source.notes) >= 1
    assert "cut (its header promises 30 frames)" in source.notes[0]
    part = open_input(path, frame_range=parse_range("0:3"))
    assert len(list(part)) == 3 and part.notes == []


def test_files_that_are_no_videos_are_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_text("certainly no film")
    (tmp_path / "b.mp4").write_bytes(b"")
    write_video(tmp_path / "c.mp4", [0, 33])
    data = (tmp_path / "c.mp4").read_bytes()
    (tmp_path / "c.mp4").write_bytes(data[: len(data) // 2])
    for name in ("a.mp4", "b.mp4", "c.mp4", "missing.mp4"):
        with pytest.raises(InputError, match=rf"^[^\n]*{name}: [^\n]+$"):
            list(open_input(tmp_path / name))


def test_a_raw_stream_has_the_times_of_its_rate(tmp_path: Path, access_units: list[bytes]) -> None:
    for name in ("raw.h264", "raw-without-suffix"):
        path = tmp_path / name
        path.write_bytes(b"".join(access_units))
        frames = list(open_input(path, rate_hz=25))
        assert [f.time_ns for f in frames] == [k * 40_000_000 for k in range(FRAMES)]
        assert [number_in(f.image) for f in frames] == list(range(FRAMES))


def test_a_raw_stream_with_b_frames_comes_in_display_order(tmp_path: Path) -> None:
    units = encode(map(picture, range(20)), "bframes=3:b-adapt=0", tune="")
    (tmp_path / "b.h264").write_bytes(b"".join(units))
    frames = list(open_input(tmp_path / "b.h264"))
    assert [number_in(f.image) for f in frames] == list(range(20))


def test_a_cut_raw_stream_is_read_to_the_cut_and_says_so(
    tmp_path: Path, access_units: list[bytes]
) -> None:
    data = b"".join(access_units[:8]) + access_units[8][: len(access_units[8]) // 3]
    (tmp_path / "cut.h264").write_bytes(data)
    source = open_input(tmp_path / "cut.h264")
    numbers = [number_in(f.image) for f in source]
    assert numbers[:8] == list(range(8)) and len(numbers) <= 9


def test_parameter_sets_are_found_across_blocks_and_missed_when_not_there(
    tmp_path: Path, access_units: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ground_station.recording.video._BLOCK_BYTES", 5)
    (tmp_path / "with.h264").write_bytes(access_units[0])
    open_input(tmp_path / "with.h264")
    slices = [u for unit in access_units for u in annexb.nal_units(unit)]
    bare = [annexb.START_CODE + u for u in slices if annexb.nal_type(u) not in (7, 8)]
    (tmp_path / "without.h264").write_bytes(b"".join(bare))
    with pytest.raises(InputError, match=r"carries no H\.264 parameter sets"):
        open_input(tmp_path / "without.h264")


@needs_streams
def test_a_real_drones_stream_is_decoded_whole() -> None:
    frames = list(open_input(STREAMS / "tello.h264"))
    assert len(frames) == 68
    assert frames[0].image.shape == (720, 960) and frames[-1].time_ns == round(67e9 / 30)


@needs_streams
def test_a_real_stream_without_parameter_sets_is_refused() -> None:
    with pytest.raises(InputError, match=r"tello-no-parameter-sets\.h264: .*carries no H\.264"):
        open_input(STREAMS / "tello-no-parameter-sets.h264")


@needs_streams
def test_a_real_cut_stream_gives_its_whole_frames_and_a_note() -> None:
    source = open_input(STREAMS / "tello-truncated.h264")
    assert len(list(source)) == 1
    assert source.notes and "cut or damaged; 1 whole frames read" in source.notes[0]
