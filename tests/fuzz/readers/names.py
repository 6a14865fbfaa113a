"""Keys, endpoints and device URIs: short texts of a network's, a file's or a person's."""

from __future__ import annotations

from pieces import Picker, refusing, stretch

from ground_station.recording.open import parse_range
from pi_firmware import uri
from pi_firmware.health import radio
from pi_firmware.settings import Settings
from pi_firmware.wire import config, credentials, keys, telemetry
from pi_firmware.wire.errors import BlimpError


def fuzz(data: bytes) -> None:
    """Each refuses in one line, and takes no text apart in two ways."""
    picker = Picker(data)
    which, text = picker.number(1) % 8, picker.rest().decode("latin-1")
    with refusing(BlimpError):
        if which == 0:
            payload = keys.payload_of(text)
            assert payload is None or keys.check_payload_id(payload) == payload
        elif which in (1, 2):
            host, port = telemetry.check_endpoint(text, certified=which == 1)
            assert host and 0 <= port <= 65535
        elif which == 3:
            found = uri.parse(text, "camera.source")
            found.number("rate", 1.0, 0.1, 100.0)
            found.only("rate")
        elif which == 4:
            radio.check_name(text)
        elif which == 5:
            assert credentials.check_name(text) == text
        elif which == 6:
            wanted = parse_range(text)
            assert wanted.count(100) <= 100
        else:
            document: dict[str, object] = {}
            config.apply_override(document, text, Settings)
            config.from_mapping(document, Settings)


def seeds() -> list[bytes]:
    """One that is right of each."""
    return [
        b"\0blimp/blimp-1/battery",
        b"\1tls/[fe80::1]:7447",
        b"\2tcp/127.0.0.1:7447",
        b"\3replay:flight.mcap?rate=30&loop=1",
        b"\4wlan0",
        b"\5payload.blimp-1",
        b"\0060:100:2",
        b"\7encoder.bitrate_kbps=800",
        b"\7battery.shutdown_command=[0x" + b"f" * 64 + b"]",
        stretch((1, b"\7encoder.bitrate_kbps=[0x"), (5000, b"f"), (1, b"]")),
        stretch((1, b"\7encoder."), (5000, b"a."), (1, b"b=1")),
        stretch((1, b"\7encoder.bitrate_kbps="), (5000, b"[")),
        stretch((1, b"\3a:b?"), (5000, b"a=b&")),
        stretch((1, b"\1tls/"), (50_000, b"a"), (1, b":1")),
    ]
