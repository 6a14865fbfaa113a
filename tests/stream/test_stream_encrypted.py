"""Off loopback nobody sees or forges the video: the payload's link with its key, and without."""

import json
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from impaired_link import ImpairedLink
from numbered_flight import GOP, capture_ns, encoded, number_in, stamped, start_payload
from receiving import Receiver

from ground_station.keys.authority import Authority
from ground_station.stream import rtp, srtp
from ground_station.stream.assembly import ReceivedFrame
from ground_station.stream.srtp import Unprotector
from ground_station.stream.telemetry import TelemetryListener
from pi_firmware.link import Link, load_key
from pi_firmware.settings import LinkSettings
from pi_firmware.wire import annexb, sei
from pi_firmware.wire.errors import StreamError

KEY = bytes(range(30))
FRAMES = 30
LIMIT_S = 30.0


@contextmanager
def eavesdropper(to_port: int) -> Iterator[tuple[int, list[bytes]]]:
    """A port whose datagrams go on to another one of this machine, and those so far."""
    heard: list[bytes] = []
    with ImpairedLink(to_port, tap=lambda datagram, _: heard.append(datagram)) as air:
        yield air.port, heard


def take(receiver: Receiver, count: int) -> list[ReceivedFrame]:
    deadline = time.monotonic() + LIMIT_S
    frames: list[ReceivedFrame] = []
    while len(frames) < count and time.monotonic() < deadline:
        if (frame := receiver.get(0.1)) is not None:
            frames.append(frame)
    return frames


def assert_secret(heard: list[bytes], key: bytes) -> None:
    """Nothing of what the packets carry can be read in them, though the key opens them all."""
    unprotector = Unprotector({"blimp-1": key})
    stamps = starts = 0
    for datagram in heard:
        plain = unprotector.unprotect(datagram)
        assert plain is not None
        packet = rtp.parse(plain, 0)
        assert packet is not None
        payload = packet.payload
        stamps += sei.UUID in payload
        starts += payload[0] & 0x1F in (annexb.NAL_SPS, annexb.NAL_IDR)
        assert sei.UUID not in datagram
        assert len(payload) < 8 or payload not in datagram
        assert len(payload) < 64 or not any(
            payload[at : at + 16] in datagram for at in range(0, len(payload) - 16, 16)
        )
    assert stamps > 0 and starts > 0


@pytest.mark.parametrize("mtu_bytes", [200, 1400])
def test_a_link_with_a_key_sends_srtp_within_its_mtu(mtu_bytes: int) -> None:
    with (
        Receiver(0, queue_frames=FRAMES, srtp_keys={"blimp-1": KEY}) as receiver,
        eavesdropper(receiver.port) as (port, air),
    ):
        link = Link(LinkSettings(port=port, mtu_bytes=mtu_bytes), 77, KEY)
        link.start()
        for index, unit in enumerate(encoded(FRAMES)):
            assert link.send(stamped(unit, index), capture_ns(index), idr=index % GOP == 0)
            assert [number_in(frame.image) for frame in take(receiver, 1)] == [index]
        assert link.flush()
        link.stop()
        assert (receiver.ssrc, receiver.payload_id) == (77, "blimp-1")
        heard = list(air)
    assert mtu_bytes - 2 <= max(map(len, heard)) <= mtu_bytes
    assert_secret(heard, KEY)


@pytest.mark.parametrize(
    ("host", "encrypted", "key", "allowed"),
    [
        ("127.0.0.1", True, None, True),
        ("::1", True, None, True),
        ("localhost", True, None, True),
        ("192.0.2.1", True, None, False),
        ("0.0.0.0", True, None, False),
        ("255.255.255.255", True, None, False),
        ("no.such.host.invalid", True, None, False),
        ("192.0.2.1", True, KEY, True),
        ("192.0.2.1", False, None, True),
        ("192.0.2.1", False, KEY, True),
        ("no.such.host.invalid", True, KEY, True),
        ("auto", True, None, True),
    ],
)
def test_without_a_key_video_goes_to_loopback_only(
    host: str, encrypted: bool, key: bytes | None, allowed: bool
) -> None:
    settings = LinkSettings(host=host, encrypted=encrypted)
    if allowed:
        Link(settings, 77, key).stop()
        return
    with pytest.raises(StreamError) as caught:
        Link(settings, 77, key)
    text = str(caught.value)
    assert "\n" not in text and f"'{host}'" in text
    assert "'blimp keys payload'" in text and "link.encrypted = false" in text


@pytest.mark.parametrize(("key", "followed"), [(None, False), (KEY, True)])
def test_a_ground_station_that_was_found_is_not_sent_plain_video(
    key: bytes | None, followed: bool
) -> None:
    link = Link(LinkSettings(host="auto"), 77, key)
    assert link.redirect("127.0.0.1", 5600) and link.destination == ("127.0.0.1", 5600)
    assert link.redirect("192.0.2.1", 5600) is followed
    assert link.destination == (("192.0.2.1", 5600) if followed else None)
    assert ("no SRTP key" in link.problem) is not followed
    assert link.redirect("127.0.0.1", 5601) and not link.problem
    link.stop()


def test_a_stream_id_is_not_used_twice_with_one_key() -> None:
    with pytest.raises(StreamError, match=r"link.ssrc is 5; with SRTP it must be 0"):
        Link(LinkSettings(ssrc=5), 5, KEY)
    Link(LinkSettings(ssrc=5, encrypted=False), 5, KEY).stop()


def test_the_payloads_key_is_read_or_refused_in_one_line(tmp_path: Path) -> None:
    assert load_key("") is None
    with pytest.raises(StreamError, match=r"srtp\.key: No such file or directory$"):
        load_key(str(tmp_path))
    path = tmp_path / "srtp.key"
    for content, reason in (("zz" * 30, "not hexadecimal digits"), ("00" * 29, "29 bytes")):
        path.write_text(content)
        with pytest.raises(StreamError, match=reason) as caught:
            load_key(str(tmp_path))
        assert "\n" not in str(caught.value) and content not in str(caught.value)
    path.write_text(KEY.hex().upper() + "\r\n")
    assert load_key(str(tmp_path)) == KEY


def test_a_flight_with_certificates_is_seen_by_its_ground_station_only(
    flight: Path, tmp_path: Path
) -> None:
    authority = Authority.create(tmp_path / "keys")
    ground, payload = authority.add("ground", "main"), authority.add("payload", "blimp-1")
    authority.add("payload", "blimp-2")
    keys = srtp.load_keys(ground)
    with (
        Receiver(0, queue_frames=100, srtp_keys=keys) as receiver,
        Receiver(0, queue_frames=100) as stranger,
        eavesdropper(receiver.port) as (port, air),
        TelemetryListener(["tls/127.0.0.1:0"], certificates=ground) as listener,
    ):
        process = start_payload(
            f"camera.uri=replay:{flight}",
            f"link.port={port}",
            f"telemetry.certificates={payload}",
            f"telemetry.connect={json.dumps(listener.endpoints)}",
        )
        try:
            out, err = process.communicate(timeout=LIMIT_S)
        finally:
            process.kill()
        assert process.returncode == 0, err
        assert "60 captured, 0 gated, 60 sent" in out
        frames = take(receiver, 60)
        assert [number_in(frame.image) for frame in frames] == list(range(60))
        assert [frame.time_ns for frame in frames] == [capture_ns(index) for index in range(60)]
        assert receiver.payload_id == "blimp-1"
        heard = list(air)
        counters = receiver.counters
        assert counters.packets == len(heard)
        assert counters.refused == counters.replayed == counters.packets_lost == 0
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as relay:
            for datagram in heard:
                relay.sendto(datagram, ("127.0.0.1", stranger.port))
                time.sleep(0.001)
        assert stranger.get(0.3) is None
        assert stranger.counters.packets > 50 and stranger.counters.decoded == 0
    assert_secret(heard, keys["blimp-1"])
