"""`pi_firmware.wire.config`: every program's settings in TOML."""

from __future__ import annotations

from pieces import Picker, refusing, scratch, stretch

from ground_station.localization.settings import LocalizerSettings
from ground_station.mapping.settings import load_settings
from ground_station.service import settings as station
from pi_firmware import settings as payload
from pi_firmware.wire import config
from pi_firmware.wire.errors import BlimpError

_FILE = scratch("config") / "settings.toml"
_LOADS = (
    lambda: payload.load(_FILE),
    lambda: station.load(_FILE),
    lambda: load_settings(_FILE),
    lambda: config.load(_FILE, LocalizerSettings),
    lambda: payload.load(_FILE, ["encoder.bitrate_kbps=800"]),
)
_KEYS = (
    b"payload_id", b"name", b"camera.source", b"encoder.bitrate_kbps", b"battery",
    b"battery.shutdown_command", b"http.port", b"payloads.ids", b"telemetry.listen",
    b"match.ratio", b"pose.sigma_px",
)  # fmt: skip


def fuzz(data: bytes) -> None:
    """Whole files, or one key with any value."""
    picker = Picker(data)
    load = picker.of(_LOADS)
    if picker.number(1) % 2:
        _FILE.write_bytes(picker.of(_KEYS) + b" = " + picker.rest() + b"\n")
    else:
        _FILE.write_bytes(picker.rest())
    with refusing(BlimpError):
        load()


def seeds() -> list[bytes]:
    """Keys of each kind, values of other kinds."""
    found = [
        bytes([which, 1, key]) + value
        for which, key, value in (
            (0, 0, b'"blimp-1"'), (0, 3, b"800"), (0, 3, b"nan"), (0, 5, b'["a", 1]'),
            (1, 7, b'["a"]'), (1, 6, b"0x1f"), (2, 9, b"0.8"), (3, 10, b"1e3"),
            (0, 4, b"{low_V = 3.5}"), (5, 3, b"true"),
            (0, 3, b"1979-05-27T07:32:00Z"), (0, 0, b'"\\u0000\\n"'), (1, 1, b'"""\na"""'),
        )
    ]  # fmt: skip
    found += [bytes([which, 0]) + b"[a]\nb = 1\n" for which in range(len(_LOADS))]
    return [
        *found,
        stretch((1, b"\0\1\5[0x"), (6000, b"f"), (1, b"]")),
        stretch((1, b"\0\1\3"), (6000, b"1")),
        stretch((1, b"\0\0camera."), (3000, b"a."), (1, b"b = 1")),
        stretch((1, b"\0\0camera.source."), (3000, b"a."), (1, b"b = 1")),
        stretch((1, b"\0\0["), (3000, b"a."), (1, b"b]")),
        stretch((1, b"\0\0"), (60_000, b'"a" . '), (1, b"b = 1")),
        stretch((1, b"\0\0["), (60_000, b"a ."), (1, b"b]")),
        stretch((1, b"\0\1\3"), (5000, b"{a=")),
    ]
