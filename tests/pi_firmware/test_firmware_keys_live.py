"""Keys of the payload's file in one live flight that has another value for each of them."""

from __future__ import annotations

import itertools
import statistics
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from tapped import LIMIT_S, Tap, start
from vehicle import Vehicle

from ground_station.stream import command as commands
from ground_station.stream.counters import Counters
from ground_station.stream.decoder import Decoder
from ground_station.stream.rtp import AccessUnit, Depacketizer
from pi_firmware import settings
from pi_firmware.wire import keys, messages, rtcp, video
from pi_firmware.wire.telemetry import Session, open_session

CONFIGURED: dict[str, object] = {
    "payload_id": "keys-7",
    "camera.uri": "test:?hang_at_s=1.5",
    "camera.width_px": 320,
    "camera.height_px": 240,
    "camera.rate_hz": 20.0,
    "camera.exposure_s": 0.004,
    "camera.gain": 3.0,
    "encoder.adapt": False,
    "encoder.min_bitrate_kbps": 250,
    "link.host": "127.0.0.2",
    "link.ssrc": 4242,
    "link.mtu_bytes": 300,
    "link.history_s": 0.6,
    "battery.uri": "fake:?percentage=0.5&minutes=180",
    "battery.period_s": 0.2,
    "battery.low_percentage": 0.7,
    "battery.low_bitrate_kbps": 700,
    "autopilot.period_s": 0.2,
    "wifi.interface": "lo",
    "supervision.period_s": 0.2,
    "supervision.frame_timeout_s": 0.7,
    "telemetry.listen": ["tcp/127.0.0.1:0"],
}
"""And those that are found when the test runs: link.port, autopilot.uri, telemetry.connect."""


class Heard:
    """All that a session hears of payloads, by the payload's id and the kind."""

    def __init__(self, session: Session) -> None:
        self.said: list[tuple[str, messages.Message]] = []
        self._subscriber = session.zenoh.declare_subscriber(keys.every_payload("*"), self._take)

    def _take(self, sample: Any) -> None:
        _, payload_id, kind = str(sample.key_expr).split("/")
        if kind in messages.KINDS:
            self.said.append(
                (payload_id, messages.decode(messages.KINDS[kind], sample.payload.to_bytes()))
            )

    def of(self, kind: str) -> list[Any]:
        return [
            message for _, message in list(self.said) if isinstance(message, messages.KINDS[kind])
        ]


class Live:
    """The flight: what was asked for, and what everyone around saw."""

    def __init__(self, stack: ExitStack, folder: Path) -> None:
        self.tap = stack.enter_context(Tap(str(CONFIGURED["link.host"])))
        self.session = open_session(listen=["tcp/127.0.0.1:0"])
        stack.callback(self.session.close)
        self.heard = Heard(self.session)
        self.vehicle = Vehicle(folder / "tty")
        stack.callback(self.vehicle.unplug)
        self.asked = CONFIGURED | {
            "link.port": self.tap.port,
            "autopilot.uri": f"serial:{self.vehicle.link.readlink()}",
            "telemetry.connect": list(self.session.listening),
        }
        self.answer: messages.Answer | None = None
        self.heard_elsewhere = 0
        self.payload_id = str(self.asked["payload_id"])
        self.process = start(self.asked)

    def fly(self) -> None:
        """Speaks to the payload until all has been seen that is to be; then ends it."""
        until = Waiting(self.vehicle.listen)
        try:
            until(lambda: self.has("radio-failed") and self.has("battery-low"))
            until(lambda: self.has("camera-restarted") and self.has("streaming-again"))
            until(self.vehicle.estimates, lambda: self.put(keys.POSE, pose()))
            until(lambda: len(self.lossy()) > 3, lambda: self.put(keys.LINK, self.report()))
            until(lambda: len(self.tap.packets(again=True)) > 3, self.ask_again)
            self.answer = commands.ask(
                self.session, self.payload_id, "bitrate", {"kbps": 50}, LIMIT_S
            )
            other = open_session(connect=self.endpoints())
            elsewhere = Heard(other)
            until(lambda: elsewhere.said)
            other.close()
            self.heard_elsewhere = len(elsewhere.said)
            self.process.terminate()
            self.process.communicate(timeout=LIMIT_S)
        finally:
            self.process.kill()
            self.process.wait()

    def ask_again(self) -> None:
        """Asks for the newest packet, and for one of seconds ago, as if they had been lost."""
        first, newest = (self.tap.packets()[place].sequence for place in (0, -1))
        self.tap.answer(rtcp.nack(1, int(str(self.asked["link.ssrc"])), [first]))
        self.tap.answer(rtcp.nack(1, int(str(self.asked["link.ssrc"])), [newest]))

    def endpoints(self) -> list[str]:
        """Where the program says that its telemetry listens, in the second line if it does."""
        assert self.process.stdout is not None
        in_vain = threading.Timer(LIMIT_S / 2, self.process.kill)
        in_vain.start()
        lines = [self.process.stdout.readline() for _ in range(2)]
        in_vain.cancel()
        return [lines[1].split()[-1]] if lines[1].startswith("telemetry on ") else []

    def put(self, kind: str, message: messages.Message) -> None:
        self.session.zenoh.put(keys.key(self.payload_id, kind), messages.encode(message))

    def report(self) -> messages.LinkReport:
        """A ground station that loses half of the video."""
        return messages.LinkReport(
            time_ns=time.time_ns(), ground="local", video_port=self.tap.port,
            ssrc=self.tap.packets()[0].ssrc, lost=0.5, round_trip_s=0.01,
        )  # fmt: skip

    def lossy(self) -> list[messages.Health]:
        """Health since the losses were heard of."""
        return [health for health in self.heard.of(keys.HEALTH) if health.lost == 0.5]

    def events(self, name: str) -> list[messages.Event]:
        return [event for event in self.heard.of(keys.EVENT) if event.name == name]

    def has(self, name: str) -> bool:
        return bool(self.events(name))


class Waiting:
    """Waits for conditions, all together for half the limit; the tests then say what failed."""

    def __init__(self, meanwhile: Callable[[], None]) -> None:
        self._meanwhile = meanwhile
        self._end_s = time.monotonic() + LIMIT_S / 2

    def __call__(
        self, condition: Callable[[], Any], also: Callable[[], Any] = lambda: None
    ) -> None:
        while not condition() and time.monotonic() < self._end_s:
            also()
            self._meanwhile()


def pose() -> messages.Pose:
    now_ns = time.time_ns()
    return messages.Pose(
        time_ns=now_ns, capture_ns=now_ns, sequence=0, state="TRACKING",
        position_m=[1.0, 2.0, 3.0], quaternion_xyzw=[-0.5, 0.5, -0.5, 0.5],
    )  # fmt: skip


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    with ExitStack() as stack:
        made = Live(stack, tmp_path_factory.mktemp("live"))
        made.fly()
        yield made


def test_no_value_asked_for_is_the_default(live: Live) -> None:
    for key, value in live.asked.items():
        default: Any = settings.Settings()
        for name in key.split("."):
            default = getattr(default, name)
        assert value != default, key


def test_it_says_its_name(live: Live) -> None:
    assert {name for name, _ in live.heard.said} == {live.asked["payload_id"]}


def test_its_camera_is_the_one_named_and_is_started_anew_in_time(live: Live) -> None:
    """Only the camera of this URI hangs."""
    assert "hang_at_s" in str(live.asked["camera.uri"])
    said = f"the camera gave no new frame for {live.asked['supervision.frame_timeout_s']} s"
    assert any(said in event.text for event in live.events("camera-restarted"))


def test_pictures_have_the_configured_size_and_rate(live: Live) -> None:
    decoder = Decoder(Counters())
    units = Depacketizer(Counters())
    pictures = (
        decoder.decode(unit)
        for packet in live.tap.packets()
        for unit in units.push(packet, False)
        if isinstance(unit, AccessUnit)
    )
    shape = next(picture.image.shape for picture in pictures if picture is not None)
    assert shape == (live.asked["camera.height_px"], live.asked["camera.width_px"])
    times_ns = [frame.info.time_ns for frame in live.tap.frames()]
    period_s = statistics.median(b - a for a, b in itertools.pairwise(times_ns)) / 1e9
    assert period_s == pytest.approx(1 / float(str(live.asked["camera.rate_hz"])), rel=0.1)


def test_frames_tell_the_exposure_and_gain_asked_for(live: Live) -> None:
    told = {(frame.info.exposure_s, frame.info.gain) for frame in live.tap.frames()}
    ((exposure_s, gain),) = told
    assert exposure_s == pytest.approx(live.asked["camera.exposure_s"])
    assert gain == pytest.approx(live.asked["camera.gain"])


def test_packets_go_where_they_should_as_they_should(live: Live) -> None:
    """Only what is sent to link.host and link.port is heard at all."""
    assert (live.tap.host, live.tap.port) == (live.asked["link.host"], live.asked["link.port"])
    assert len(live.tap.frames()) > 20
    assert {packet.ssrc for packet in live.tap.packets()} == {live.asked["link.ssrc"]}
    # What is sent again is larger, and must fit, too.
    sizes = [len(datagram) for datagram in live.tap.datagrams if datagram[1] & 0x7F == 96]
    assert max(sizes) == int(str(live.asked["link.mtu_bytes"])) - video.OSN_BYTES


def test_what_was_sent_of_late_and_nothing_older_is_sent_again(live: Live) -> None:
    sent = {packet.sequence: packet for packet in live.tap.packets()}
    again = live.tap.packets(again=True)
    assert again and all(sent[packet.sequence].payload == packet.payload for packet in again)
    (ssrc,) = {packet.ssrc for packet in again}
    assert live.heard.of(keys.HEALTH)[-1].rtx_ssrc == ssrc != live.asked["link.ssrc"]
    # The flight had lasted for longer than link.history_s when its first packet was asked for.
    assert live.tap.packets()[0].sequence not in {packet.sequence for packet in again}


def test_the_battery_is_the_gauges_and_is_read_so_often(live: Live) -> None:
    readings = live.heard.of(keys.BATTERY)
    assert "percentage=0.5&minutes=180" in str(live.asked["battery.uri"])  # of 0.6 Ah
    assert readings[0].percentage == pytest.approx(0.5, abs=0.15)
    assert readings[0].current == pytest.approx(-0.2, abs=0.01)
    assert period_s(readings) < 2.5 * float(str(live.asked["battery.period_s"]))


def test_a_low_battery_lowers_the_bit_rate(live: Live) -> None:
    last = live.heard.of(keys.BATTERY)[-1]
    assert last.alarm == messages.ALARM_LOW
    assert 0.25 < last.percentage < float(str(live.asked["battery.low_percentage"]))
    (event,) = live.events("battery-low")
    assert event.text.endswith(f"{live.asked['battery.low_bitrate_kbps']} kbit/s asked for")
    assert live.lossy()[0].bitrate_kbps == live.asked["battery.low_bitrate_kbps"]


def test_an_encoder_that_must_not_adapt_does_not(live: Live) -> None:
    assert live.asked["encoder.adapt"] is False
    assert {health.bitrate_kbps for health in live.lossy()[:4]} == {700}


def test_no_command_goes_below_the_least_bit_rate(live: Live) -> None:
    assert live.answer is not None
    assert live.answer.values == {"kbps": live.asked["encoder.min_bitrate_kbps"]}


def test_the_autopilot_gets_poses_and_says_its_state_so_often(live: Live) -> None:
    """At the far end of the line that autopilot.uri names."""
    assert str(live.asked["autopilot.uri"]).startswith("serial:/dev/")
    assert live.vehicle.estimates()[0].z == pytest.approx(-3.0)
    states = live.heard.of(keys.AUTOPILOT)
    assert period_s(states) < 2.5 * float(str(live.asked["autopilot.period_s"]))


def test_the_radio_is_the_one_named(live: Live) -> None:
    (event,) = live.events("radio-failed")
    assert event.text == f"interface: {live.asked['wifi.interface']} is no radio"


def test_health_comes_so_often(live: Live) -> None:
    said = live.heard.of(keys.HEALTH)
    assert period_s(said) < 2.5 * float(str(live.asked["supervision.period_s"]))


def test_it_connects_and_listens_where_it_should(live: Live) -> None:
    """telemetry.connect is where all else was heard, telemetry.listen what another connected to."""
    assert live.heard.said and live.asked["telemetry.connect"] == list(live.session.listening)
    assert live.heard_elsewhere > 0 and live.asked["telemetry.listen"]


def period_s(said: list[Any]) -> float:
    """The median time between messages; each default is 1 s."""
    return statistics.median(b.time_ns - a.time_ns for a, b in itertools.pairwise(said)) / 1e9
