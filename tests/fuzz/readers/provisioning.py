"""`deploy.provisioning` and `deploy.board.settings`: what a card is told, and what comes of it."""

from __future__ import annotations

from pieces import Picker, refusing, stretch, with_a_line

from deploy.board import settings
from deploy.errors import DeployError
from deploy.provisioning.model import Provisioning, check_authorized_key
from deploy.provisioning.text import parse, parse_wifi, render
from deploy.provisioning.wpa import wpa_supplicant_conf

KEY = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIAABAgMEBQYHCAkKCwwNDg8QERITFBUWFxgZGhscHR4f a@b"
WHOLE = f"""\
schema = 1
[payload]
id = "blimp-1"
[wifi]
ssid = "hall"
password = ""
security = "wpa2"
country = "DE"
hidden = false
[ground_station]
host = "auto"
video_port = 5600
telemetry = ["tls/10.0.0.1:7447"]
[ssh]
authorized_keys = ["{KEY}"]
""".encode()
_STORED = "network={\n    ssid=68616c6c\n    psk=" + "0" * 64 + "\n}\n"


def fuzz(data: bytes) -> None:
    """What is taken is written as the same, and nothing of it stands in wpa_supplicant's file."""
    picker = Picker(data)
    which = picker.number(1)
    with refusing(DeployError):
        if which == 255:
            parse_wifi(picker.rest(), "wifi.toml")
        elif which == 254:
            check_authorized_key(picker.rest().decode("latin-1"), "a key")
        elif which == 253:
            document = settings.read(picker.rest(), "payload.toml")
            made = settings.dump(settings.merged({}, document, Provisioning("a"), "/x"))
            assert settings.dump(settings.read(made.encode(), "it")) == made
        else:
            found = parse(with_a_line(Picker(data), WHOLE))
            assert parse(render(found).encode()) == found
            if found.wifi is None or found.wifi.is_psk or not found.wifi.password:
                assert wpa_supplicant_conf(found, _STORED).isascii()


def seeds() -> list[bytes]:
    """Whole files of each kind, and single lines of other kinds."""
    return [
        b"\xfc" + WHOLE,
        b"\xff" + b"".join(WHOLE.splitlines(keepends=True)[3:9]),
        b"\xfe" + KEY.encode(),
        b"\xfd[encoder]\nbitrate_kbps = 800\nx = [1, {a = 1.5}]\nd = 1979-05-27\n",
        b'\5password = "' + b"0" * 64 + b'"',
        b'\4ssid_hex = "00ff"',
        b"\x0bvideo_port = 0x" + b"f" * 400,
        b"\x0ctelemetry = [0x" + b"f" * 3800 + b", []]",
        b'\x0ahost = "\xc2\xb2.\xc2\xb3"',
        b'\x0ahost = "::%\\n"',
        stretch((1, b"\xfc"), (5000, b"a."), (1, b"b = 1")),
        stretch((1, b"\xfd"), (3000, b"a."), (1, b"b = 1")),
        stretch((1, b"\xfd"), (60_000, b"a."), (1, b"b = 1")),
        stretch((1, b"\xfc["), (60_000, b"a."), (1, b"b]")),
        stretch((1, b"\xfda = "), (5000, b"[")),
        stretch((1, b"\xfcwifi."), (3000, b"a."), (1, b"b = 1")),
        stretch((1, b"\x0ahost."), (3000, b"a."), (1, b"b = 1")),
        stretch((1, b"\xfe" + KEY.encode()[:60]), (3000, b"A")),
    ]
