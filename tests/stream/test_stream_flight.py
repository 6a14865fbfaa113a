"""The payload's program flies a recording to the receiver: every frame is accounted for."""

import json
import signal
import socket
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import av
import pytest
from av.video.frame import PictureType
from impaired_link import ImpairedLink, Impairment
from numbered_flight import (
    START_NS,
    capture_ns,
    encoded,
    number_in,
    start_payload,
    write_flight,
)
from receiving import Receiver

from ground_station.stream import rtp
from ground_station.stream.assembly import ReceivedFrame
from ground_station.stream.counters import Counters
from ground_station.stream.telemetry import PayloadState, TelemetryListener
from pi_firmware.settings import CameraSettings
from pi_firmware.sources import open_source
from pi_firmware.wire import annexb, messages, sei
from pi_firmware.wire.errors import BlimpError
from pi_firmware.wire.recording import RecordingWriter

LIMIT_S = 30.0


@dataclass
class Flight:
    """What came of one run of the payload."""

    frames: list[ReceivedFrame]
    state: PayloadState
    end: messages.Event
    status: int
    out: str
    err: str
    receiver: Receiver
    link: ImpairedLink


def fly(
    *settings: str,
    loss: float = 0.0,
    on_frame: Callable[[subprocess.Popen[str], int], None] = lambda process, count: None,
) -> Flight:
    """Runs the payload to its end, taking all frames, and listens to its telemetry."""
    with (
        Receiver(0, queue_frames=100) as receiver,
        ImpairedLink(receiver.port, Impairment(loss=loss), seed=2) as link,
        TelemetryListener(["tcp/127.0.0.1:0"]) as listener,
    ):
        process = start_payload(
            f"link.port={link.port if loss else receiver.port}",
            f"telemetry.connect={json.dumps(listener.endpoints)}",
            *settings,
        )
        try:
            frames = []
            while (frame := receiver.get(0.5)) or process.poll() is None:
                if frame:
                    frames.append(frame)
                    on_frame(process, len(frames))
            out, err = process.communicate(timeout=LIMIT_S)
        finally:
            process.kill()
        ends = (messages.EVENT_END_OF_STREAM, messages.EVENT_STOPPED)
        state = listener.wait(
            "blimp-1", lambda s: any(e.name in ends for e in s.events) and not s.alive, LIMIT_S
        )
        assert state is not None, err
        end = next(event for event in state.events if event.name in ends)
        return Flight(frames, state, end, process.returncode, out, err, receiver, link)


def assert_true(frames: list[ReceivedFrame]) -> None:
    """Each picture is the one captured at the time that came with it."""
    assert [frame.time_ns for frame in frames] == [
        capture_ns(number_in(frame.image)) for frame in frames
    ]


def test_all_frames_of_a_flight_arrive_with_their_exact_capture_times(flight: Path) -> None:
    flown = fly(f"camera.uri=replay:{flight}")
    assert flown.status == 0, flown.err
    assert_true(flown.frames)
    assert [frame.sequence for frame in flown.frames] == list(range(60))
    assert [number_in(frame.image) for frame in flown.frames] == list(range(60))
    for index, frame in enumerate(flown.frames):
        assert frame.exposure_s == pytest.approx(0.01 + index / 2**16, rel=1e-6)
        assert frame.gain == 2.0
        assert frame.clock_ns <= frame.arrival_ns
    assert flown.state.ssrc == flown.receiver.ssrc
    counters = flown.receiver.counters
    assert counters.packets_lost == counters.withheld == counters.garbage == 0
    assert flown.end.name == messages.EVENT_END_OF_STREAM
    assert flown.end.values["captured"] == flown.end.values["sent"] == 60
    assert "60 captured, 0 gated, 60 sent" in flown.out
    assert flown.state.battery is not None and flown.state.battery.power_supply_status == 2
    # The gate said for every frame what its video says.
    decisions = flown.state.decisions
    assert list(decisions) == [frame.sequence for frame in flown.frames]
    for frame in flown.frames:
        said = decisions[frame.sequence]
        assert said.passed and said.capture_ns == frame.time_ns
        assert said.entropy_bits == pytest.approx(frame.entropy_bits, rel=1e-6)
        assert said.sharpness == pytest.approx(frame.sharpness, rel=1e-6)


def test_dark_frames_are_gated_and_counted_but_a_heartbeat_comes(tmp_path: Path) -> None:
    dark = set(range(15, 45))
    recording = write_flight(tmp_path / "dark.mcap", 60, dark)
    flown = fly(f"camera.uri=replay:{recording}?speed=2", "gate.heartbeat_s=0.2")
    assert flown.status == 0, flown.err
    assert_true(flown.frames)
    counts = flown.state.frames
    assert counts is not None
    assert counts.captured == 60 == counts.gated + counts.sent
    assert counts.sent == len(flown.frames)
    beats = [frame for frame in flown.frames if frame.heartbeat]
    assert counts.heartbeats == len(beats) == 2
    assert {frame.sequence for frame in beats} < dark
    assert all(frame.entropy_bits < 5.0 for frame in beats)
    gated = {sequence for sequence, said in flown.state.decisions.items() if not said.passed}
    assert gated == dark - {frame.sequence for frame in beats}
    assert {frame.sequence for frame in flown.frames} == set(range(60)) - gated


def test_at_five_percent_loss_every_frame_is_right_and_accounted_for(flight: Path) -> None:
    settings = ("encoder.gop_frames=3", "encoder.bitrate_kbps=400")
    flown = fly(f"camera.uri=replay:{flight}", *settings, loss=0.05)
    counters, link = flown.receiver.counters, flown.link
    assert flown.status == 0, flown.err
    assert link.counts.lost > 0
    late_ns = [abs(frame.time_ns - capture_ns(frame.sequence)) for frame in flown.frames]
    assert max(late_ns) <= 2_000_000 and late_ns.count(0) > 0.8 * len(late_ns)  # a lost SEI's
    for frame in flown.frames:
        if frame.damaged is None or not frame.damaged[:2].any():  # where the number is
            assert number_in(frame.image) == frame.sequence
    assert counters.packets == link.counts.passed
    withheld = counters.withheld + counters.failed + counters.unstamped
    assert counters.access_units == counters.received + withheld
    assert counters.received == len(flown.frames) and counters.decoded < 60
    counts = flown.state.frames
    assert counts is not None and counts.sent == 60
    # Frames of which nothing arrived are known by their sequence numbers, from the telemetry.
    lost = {s for s, said in flown.state.decisions.items() if said.passed}
    lost -= {frame.sequence for frame in flown.frames}
    assert len(lost) == 60 - len(flown.frames) >= counters.withheld


def test_what_is_on_the_wire_is_as_agreed(tmp_path: Path) -> None:
    """Frames far apart are the hard case: only each fifth one passes the gate."""
    sparse = write_flight(tmp_path / "sparse.mcap", 75, [i for i in range(75) if i % 5])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(0.2)
        process = start_payload(
            f"camera.uri=replay:{sparse}?pace=stepped",
            f"link.port={receiver.getsockname()[1]}",
            "link.ssrc=4242",
            "telemetry.enabled=false",
        )
        datagrams = []
        while True:
            try:
                datagrams.append(receiver.recv(65535))
            except TimeoutError:
                if process.poll() is not None:
                    break
        assert process.communicate()[1] == ""
    counters = Counters()
    reorderer, depacketizer = rtp.Reorderer(counters), rtp.Depacketizer(counters)
    units = []
    for datagram in datagrams:
        assert len(datagram) <= 1400
        packet = rtp.parse(datagram, 0)
        assert packet is not None and packet.ssrc == 4242
        for ordered, gap in reorderer.push(packet):
            units += depacketizer.push(ordered, gap)
    assert counters == Counters() and all(unit.complete for unit in units)
    infos = [sei.find(unit.data) for unit in units]
    assert [info and info.sequence for info in infos] == list(range(0, 75, 5))
    idr_ns = []
    codec = av.CodecContext.create("h264", "r")
    for unit, info in zip(units, infos, strict=True):
        types = annexb.nal_types(unit.data)
        first_slice = next(i for i, kind in enumerate(types) if kind in (1, 5))
        assert annexb.NAL_SEI in types[:first_slice]
        if annexb.is_idr(unit.data):
            assert {annexb.NAL_SPS, annexb.NAL_PPS} < set(types[:first_slice])
            assert info is not None
            idr_ns.append(info.time_ns)
        for frame in codec.decode(av.Packet(unit.data)):
            assert frame.pict_type != PictureType.B
    idr_ns.append(capture_ns(70))
    assert len(idr_ns) >= 3
    assert max(b - a for a, b in pairwise(idr_ns)) <= 1_010_000_000


def test_a_slower_camera_takes_its_frames_of_a_stretch_and_speed_shortens_it(flight: Path) -> None:
    uri = f"camera.uri=replay:{flight}?rate_hz=10&start_s=0.5&duration_s=1&speed=4"
    flown = fly(uri)
    assert_true(flown.frames)
    first = capture_ns(0) + 500_000_000
    stretch = [i for i in range(60) if first <= capture_ns(i) < first + 1_000_000_000]
    assert [number_in(frame.image) for frame in flown.frames] == stretch[::3]
    assert [frame.sequence for frame in flown.frames] == list(range(10))
    took_ns = flown.frames[-1].clock_ns - flown.frames[0].clock_ns
    assert took_ns < 1_000_000_000


def test_a_loop_goes_on_with_rising_times_until_it_is_stopped(flight: Path) -> None:
    def stop(process: subprocess.Popen[str], count: int) -> None:
        if count == 40:
            process.send_signal(signal.SIGTERM)

    uri = f"camera.uri=replay:{flight}?duration_s=0.5&loop=1&speed=2"
    flown = fly(uri, on_frame=stop)
    assert flown.status == 0, flown.err
    times = [frame.time_ns for frame in flown.frames]
    assert times == sorted(set(times))
    assert [number_in(frame.image) for frame in flown.frames[:32]] == [*range(15), *range(15), 0, 1]
    gaps = [b - a for a, b in pairwise(times)]
    assert max(gaps) < 40_000_000  # rounds join at the camera's own pace


def test_a_ctrl_c_ends_the_flight_in_order(flight: Path) -> None:
    def stop(process: subprocess.Popen[str], count: int) -> None:
        if count == 10:
            process.send_signal(signal.SIGINT)

    flown = fly(f"camera.uri=replay:{flight}?loop=1", on_frame=stop)
    assert (flown.status, flown.err) == (0, "")
    assert flown.end.name == messages.EVENT_STOPPED
    # What was captured before the signal was still sent.
    assert flown.end.values["captured"] == flown.end.values["sent"] == len(flown.frames)


def test_a_cut_recording_is_flown_up_to_the_cut_and_says_so(flight: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(flight.read_bytes()[: int(0.6 * flight.stat().st_size)])
    flown = fly(f"camera.uri=replay:{cut}?pace=stepped")
    assert flown.status == 0, flown.err
    assert 10 < len(flown.frames) < 60
    assert_true(flown.frames)
    assert flown.err.count("\n") == 1 and "is cut and was played up to the cut" in flown.err
    assert messages.EVENT_SOURCE_CUT in [event.name for event in flown.state.events]


def video_of(path: Path, units: list[bytes]) -> Path:
    with RecordingWriter(path) as recording:
        for index, unit in enumerate(units):
            recording.write_video(START_NS + index * 10**7, unit)
    return path


def make_missing(folder: Path) -> Path:
    return folder / "none.mcap"


def make_text(folder: Path) -> Path:
    (folder / "text.mcap").write_text("no recording")
    return folder / "text.mcap"


def make_without_video(folder: Path) -> Path:
    return video_of(folder / "empty.mcap", [])


def make_without_parameter_sets(folder: Path) -> Path:
    return video_of(folder / "sets.mcap", list(encoded(12)[1:]))


def make_noise(folder: Path) -> Path:
    return video_of(folder / "noise.mcap", [b"\x00\x00\x00\x01\x65" + b"\xa5" * 99] * 5)


def make_large(folder: Path) -> Path:
    return video_of(folder / "large.mcap", list(encoded(1)))


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (make_missing, "No such file"),
        (make_text, "no MCAP recording"),
        (make_without_video, "no video"),
        (make_without_parameter_sets, "no parameter sets"),
        (make_noise, "no parameter sets"),
        (make_large, "its pictures are 640x480, camera.width_px x height_px is 320x480"),
    ],
)
def test_a_recording_that_cannot_be_flown_is_one_line(
    tmp_path: Path, make: Callable[[Path], Path], named: str
) -> None:
    path = make(tmp_path)
    with pytest.raises(BlimpError) as refused:
        open_source(CameraSettings(uri=f"replay:{path}", width_px=320))
    said = str(refused.value)
    assert "\n" not in said and str(path) in said and named in said


def test_a_name_without_an_address_is_told_and_stops_nothing(flight: Path) -> None:
    """Wi-Fi may come later than the camera: frames are discarded until it has an address."""
    process = start_payload(
        f"camera.uri=replay:{flight}?speed=4",
        "telemetry.enabled=false",
        "link.host=no.such.host.invalid",
        "link.encrypted=false",
    )
    out, err = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 0
    assert err.count("\n") == 1 and "link.host 'no.such.host.invalid'" in err
    assert "60 captured, 0 gated, 0 sent (0 as heartbeat), 60 discarded" in out
