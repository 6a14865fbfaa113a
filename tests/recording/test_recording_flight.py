"""Flight recordings as a source of frames."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numbered_video import FRAMES, PERIOD_NS, START_NS, encode, number_in, picture

from ground_station.errors import InputError
from ground_station.recording.flight import trajectory_of
from ground_station.recording.open import open_input, parse_range
from pi_firmware.wire import annexb
from pi_firmware.wire.errors import BlimpError, RecordingError
from pi_firmware.wire.recording import ESTIMATE_TOPIC, TRUTH_TOPIC, RecordingWriter

MakeFlight = Callable[..., Path]


@pytest.mark.parametrize("parameters", ["", "ref=4", "bframes=2:b-adapt=0"])
def test_every_frame_keeps_the_capture_time_of_its_access_unit(
    make_flight: MakeFlight, parameters: str
) -> None:
    # Without "zerolatency" decoders hold pictures back; with B-frames units are out of order, and
    # unit k then shows another picture than the k-th: what it shows is what it was captured with.
    units = encode(map(picture, range(FRAMES)), parameters, tune="")
    source = open_input(make_flight(units))
    frames = list(source)
    assert len(frames) == FRAMES and source.notes == []
    assert {f.time_ns for f in frames} == {START_NS + k * PERIOD_NS for k in range(FRAMES)}
    for frame in frames:
        assert frame.time_ns == START_NS + frame.index * PERIOD_NS
        assert frame.name == f"frame-{frame.index:06d}"
        if "bframes" not in parameters:
            assert number_in(frame.image) == frame.index


def test_the_camera_comes_with_its_readout_time(
    make_flight: MakeFlight, access_units: list[bytes]
) -> None:
    camera = open_input(make_flight(access_units)).camera
    assert camera is not None
    assert (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px) == (150, 151, 79.5, 59.5)
    np.testing.assert_allclose(camera.distortion, [0.1, -0.2, 0.001, 0.002, 0.03])
    assert (camera.width_px, camera.height_px, camera.readout_s) == (160, 120, 0.02)
    without = open_input(make_flight(access_units, name="b.mcap", readout=None)).camera
    assert without is not None and without.readout_s == 0.0


@pytest.mark.parametrize("name", ["kannala_brandt", "equidistant"])
def test_a_fisheye_comes_as_one(
    make_flight: MakeFlight, access_units: list[bytes], name: str
) -> None:
    numbers = (0.02, -0.003, 0.001, -0.0002)
    path = make_flight(access_units, distortion=numbers, distortion_model=name)
    camera = open_input(path).camera
    assert camera is not None and camera.model == "fisheye"
    np.testing.assert_array_equal(camera.distortion, numbers)
    assert (camera.distortion_model, camera.readout_s) == ("kannala_brandt", 0.02)


def test_an_uncalibrated_recording_has_no_camera(
    make_flight: MakeFlight, access_units: list[bytes]
) -> None:
    assert open_input(make_flight(access_units, matrix=[0] * 9)).camera is None


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"matrix": (float("nan"), 0, 80, 0, 150, 60, 0, 0, 1)}, "fx_px"),
        ({"matrix": (-5.0, 0, 80, 0, 150, 60, 0, 0, 1)}, "fx_px"),
        ({"distortion": (0.1, 0, 0, 0, float("inf"))}, "k3"),
        ({"distortion": [0.0] * 8}, "8 parameters"),
        ({"distortion_model": "kannala_brandt"}, "kannala_brandt' with 5 parameters"),
        ({"distortion_model": "rational_polynomial"}, "rational_polynomial"),
        ({"readout": "twenty"}, "readout_s"),
        ({"readout": "nan"}, "readout_s"),
    ],
)
def test_a_wrong_calibration_is_refused_by_name(
    make_flight: MakeFlight, access_units: list[bytes], change: dict[str, object], says: str
) -> None:
    path = make_flight(access_units[:1], **change)
    with pytest.raises(BlimpError, match=rf"^[^\n]*flight\.mcap[^\n]*{says}[^\n]*$"):
        open_input(path)


def test_a_calibration_of_another_size_is_refused(
    make_flight: MakeFlight, access_units: list[bytes]
) -> None:
    source = open_input(make_flight(access_units, width_px=640))
    with pytest.raises(InputError, match="its video has 160x120 px, its calibration 640x120 px"):
        list(source)


def test_ranges_and_counts(make_flight: MakeFlight, access_units: list[bytes]) -> None:
    path = make_flight(access_units)
    assert open_input(path).count() == FRAMES
    source = open_input(path, frame_range=parse_range("7:30:5"))
    frames = list(source)
    assert [f.index for f in frames] == [7, 12, 17, 22, 27] and source.count() == 5
    assert [number_in(f.image) for f in frames] == [7, 12, 17, 22, 27]
    assert [f.time_ns for f in frames] == [START_NS + f.index * PERIOD_NS for f in frames]
    assert source.notes == []  # what a range leaves out is no cut
    with pytest.raises(InputError, match="in the range 90:95"):
        list(open_input(path, frame_range=parse_range("90:95")))


def test_iterating_twice_starts_anew(make_flight: MakeFlight, access_units: list[bytes]) -> None:
    path = make_flight(access_units)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    source = open_input(path)
    first, notes = [f.time_ns for f in source], list(source.notes)
    assert [f.time_ns for f in source] == first and source.notes == notes


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8, 0.97])
def test_a_cut_recording_is_read_to_the_cut_and_says_so(
    make_flight: MakeFlight, access_units: list[bytes], share: float
) -> None:
    path = make_flight(access_units)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    source = open_input(path)
    numbers = [number_in(f.image) for f in source]
    assert numbers == list(range(len(numbers))) and len(numbers) > FRAMES * share * 0.3
    assert source.notes == [
        f"{path}: cut (the file ends before its footer); {len(numbers)} frames read"
    ]
    assert source.count() is None and source.camera is not None


def test_a_recording_cut_before_its_first_frame_is_refused(
    make_flight: MakeFlight, access_units: list[bytes]
) -> None:
    path = make_flight(access_units)
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(InputError, match=r"flight\.mcap: cut .*no whole frame"):
        list(open_input(path))


def test_a_damaged_access_unit_does_not_shift_those_after_it(
    make_flight: MakeFlight, access_units: list[bytes]
) -> None:
    units = [*access_units[:15], b"\0\0\0\1\x65 no picture", *access_units[16:]]
    source = open_input(make_flight(units))
    frames = {f.index: f for f in source}
    assert 15 not in frames and len(source.notes) == 1 and "damaged" in source.notes[0]
    for k in (*range(15), *range(20, FRAMES)):  # from the next IDR on
        assert frames[k].time_ns == START_NS + k * PERIOD_NS
        assert number_in(frames[k].image) == k


def test_a_recording_without_parameter_sets_is_refused(
    make_flight: MakeFlight, access_units: list[bytes]
) -> None:
    bare = [
        b"".join(
            annexb.START_CODE + u
            for u in annexb.nal_units(unit)
            if annexb.nal_type(u) not in (annexb.NAL_SPS, annexb.NAL_PPS)
        )
        for unit in access_units
    ]
    with pytest.raises(InputError, match=r"carries no H\.264 parameter sets"):
        list(open_input(make_flight(bare)))


def test_a_recording_without_video_and_one_of_another_codec_are_refused(
    tmp_path: Path, make_flight: MakeFlight
) -> None:
    with pytest.raises(InputError, match="gives no video frames"):
        list(open_input(make_flight([])))
    from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo

    path = tmp_path / "h265.mcap"
    with RecordingWriter(path) as writer:
        writer.write_protobuf("/camera/video", 1, CompressedVideo(format="h265", data=b"x"))
    with pytest.raises(RecordingError, match="'h265'; only h264"):
        list(open_input(path))
    with RecordingWriter(path) as writer:
        strange = CompressedVideo(format="h\x0c\n4" + "x" * 100, data=b"x")
        writer.write_protobuf("/camera/video", 1, strange)
    with pytest.raises(RecordingError) as refused:
        list(open_input(path))
    assert str(refused.value).isprintable() and "x" * 40 not in str(refused.value)


def test_a_file_that_is_no_recording_is_refused(tmp_path: Path) -> None:
    for name, content in (("a.mcap", b"no recording"), ("b.mcap", b"\x89MC"), ("c.mcap", b"")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(BlimpError, match=rf"^[^\n]*{name}: [^\n]*$"):
            list(open_input(tmp_path / name))


def test_the_truth_of_a_recording_is_a_trajectory(
    make_flight: MakeFlight, access_units: list[bytes]
) -> None:
    path = make_flight(access_units)
    truth = trajectory_of(path, TRUTH_TOPIC)
    assert truth.time_ns.tolist() == [START_NS + k * PERIOD_NS for k in range(FRAMES)]
    np.testing.assert_allclose(truth.position_m[:, 0], np.arange(FRAMES))
    np.testing.assert_allclose(truth.quaternion_xyzw, np.tile([0, 0, 0, 1.0], (FRAMES, 1)))
    with pytest.raises(InputError, match=r"no poses on /estimate/pose"):
        trajectory_of(path, ESTIMATE_TOPIC)


def test_the_truth_of_a_cut_recording_says_where_it_ends(
    make_flight: MakeFlight, access_units: list[bytes]
) -> None:
    path = make_flight(access_units)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    notes: list[str] = []
    truth = trajectory_of(path, TRUTH_TOPIC, notes)
    assert 0 < len(truth) < FRAMES
    assert notes == [f"{path}: cut (the file ends before its footer); {len(truth)} poses read"]


@pytest.mark.parametrize(
    ("position", "quaternion"), [([np.nan, 0, 0], [0, 0, 0, 1]), ([0, 0, 0], [0, 0, 0, 0])]
)
def test_a_truth_that_is_not_finite_is_refused(
    tmp_path: Path, position: list[float], quaternion: list[float]
) -> None:
    with RecordingWriter(tmp_path / "p.mcap") as writer:
        writer.write_pose(5, position, quaternion, topic=TRUTH_TOPIC)
    with pytest.raises(InputError, match="not finite or has a zero quaternion"):
        trajectory_of(tmp_path / "p.mcap", TRUTH_TOPIC)
