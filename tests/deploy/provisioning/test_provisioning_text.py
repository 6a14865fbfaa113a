"""`blimp.toml`: what is written comes back byte for byte; what is wrong is refused by name."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from deploy.errors import DeployError
from deploy.provisioning.model import (
    CODES,
    GroundStation,
    Provisioning,
    Wifi,
    keeps_password,
    without_secrets,
)
from deploy.provisioning.text import parse, render

ED25519 = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIAABAgMEBQYHCAkKCwwNDg8QERITFBUWFxgZGhscHR4f a pilot"
GOOD = """\
schema = 1
[payload]
id = "blimp-1"
[wifi]
ssid = "hall"
password = "correct horse"
country = "DE"
[ground_station]
host = "192.168.7.1"
[ssh]
authorized_keys = []
"""
HOSTILE = [
    "plain name",
    "quote \" and 'quote'",
    "$(touch MARKER) `touch MARKER`",
    "back\\slash \\n \\u0041",
    "two\nlines\r\n[payload]",
    "# no comment ]]",
    "\"\"\"\n'''",
    "tab\tbell\x07del\x7f",
    "ünïcödé 電波",
    "🎈🎈 👩‍🚀",
    "nbsp\u00a0ls\u2028bom\ufeff",
    "; rm -rf / & }network={",
]


def _provisioning(ssid: bytes = b"hall", password: str = "correct horse") -> Provisioning:
    return Provisioning("blimp-1", Wifi(ssid, "DE", password))


@pytest.mark.parametrize("text", HOSTILE)
def test_hostile_names_and_passwords_come_back_byte_for_byte(text: str) -> None:
    password = (text * 8).encode()[:63].decode(errors="ignore")
    made = _provisioning(text.encode()[:32], password)
    written = render(made).encode()
    assert parse(written) == made
    assert parse(written.replace(b"\n", b"\r\n")) == made  # a Windows editor's line ends
    assert parse(b"\xef\xbb\xbf" + written) == made  # and its byte order mark


texts = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"))
passwords = st.one_of(
    st.just(""),
    texts.filter(lambda text: 8 <= len(text.encode()) <= 63),
    st.binary(min_size=32, max_size=32).map(bytes.hex),
)
hosts = st.sampled_from(["auto", "10.0.0.1", "fe80::1", "station.local", "gs"])
endpoints = st.sampled_from(["tls/10.0.0.1:7447", "tls/[fe80::1]:1", "tls/gs:65535"])


@given(
    ssid=st.binary(min_size=1, max_size=32)
    | texts.map(str.encode).filter(lambda name: 1 <= len(name) <= 32),
    password=passwords,
    country=st.sampled_from(sorted(CODES)),
    hidden=st.booleans(),
    host=hosts,
    port=st.integers(1, 65535),
    telemetry=st.lists(endpoints, max_size=8).map(tuple),
    keys=st.integers(0, 3),
    wifi=st.booleans(),
)
def test_what_is_rendered_parses_as_the_same(
    ssid: bytes, password: str, country: str, hidden: bool, host: str, port: int,
    telemetry: tuple[str, ...], keys: int, wifi: bool,
) -> None:  # fmt: skip
    made = Provisioning(
        "blimp_2",
        Wifi(ssid, country, password, hidden=hidden) if wifi else None,
        GroundStation(host, port, telemetry),
        (ED25519,) * keys,
    )
    assert parse(render(made).encode()) == made


def test_defaults_are_those_of_the_format() -> None:
    read = parse(b'schema = 1\n[payload]\nid = "a"\n')
    assert read == Provisioning("a", None, GroundStation("auto", 5600, ()), ())
    assert parse(GOOD.encode()).ground_station.endpoints == ("tls/192.168.7.1:7447",)
    assert GroundStation("fe80::1").endpoints == ("tls/[fe80::1]:7447",)
    assert GroundStation("auto").endpoints == ()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (('schema = 1', 'schema = 2'), "a newer image"),
        (('schema = 1', 'schema = true'), "'schema' is True; expected 1"),
        (('schema = 1\n', ''), "'schema' is missing"),
        (('id = "blimp-1"', 'id = "Blimp 1"'), "1 to 32 of a-z"),
        (('id = "blimp-1"', 'name = "x"'), "unknown key 'payload.name' (known here: id)"),
        (('id = "blimp-1"', ''), "'payload.id' is missing"),
        (('[ssh]', '[sshd]'), "unknown key 'sshd'"),
        (('ssid = "hall"', 'ssid = ""'), "has 0 bytes; allowed: 1 to 32 bytes"),
        (('ssid = "hall"', f'ssid = "{"ü" * 17}"'), "has 34 bytes"),
        (('ssid = "hall"', 'ssid_hex = "0g"'), "'wifi.ssid_hex' is '0g'"),
        (('ssid = "hall"', 'ssid = "a"\nssid_hex = "00"'), "either 'wifi.ssid'"),
        (('ssid = "hall"', ''), "either 'wifi.ssid'"),
        (('"correct horse"', '"short"'), "has 5 bytes; allowed: 8 to 63 bytes"),
        (('"correct horse"', f'"{"x" * 64}"'), "has 64 bytes"),
        (('"correct horse"', '"nul \\u0000 inside"'), "NUL"),
        (('"correct horse"', '12345678'), "expected a text in quotes"),
        (('"DE"', '"de"'), "is it DE?"),
        (('"DE"', '"UK"'), "is it GB?"),
        (('"DE"', '"00"'), "expected the two capital letters"),
        (('country = "DE"\n', ''), "'wifi.country' is missing"),
        (('country', 'security = "wep"\ncountry'), "allowed: wpa2, wpa3, open"),
        (('country', 'security = "open"\ncountry'), "it must be empty"),
        (('country', 'hidden = 1\ncountry'), "expected true or false"),
        (('"192.168.7.1"', '"192.168.7.300"'), "an IP address or a host's name"),
        (('"192.168.7.1"', '"a b"'), "an IP address or a host's name"),
        (('[ssh]', 'video_port = 0\n[ssh]'), "is 0; allowed: 1 to 65535"),
        (('[ssh]', f'video_port = {"9" * 4000}\n[ssh]'), "allowed: 1 to 65535"),
        (('[ssh]', 'telemetry = ["tcp/10.0.0.1:1"]\n[ssh]'), "expected tls/HOST:PORT"),
        (('[ssh]', 'telemetry = [1]\n[ssh]'), "expected texts in quotes"),
        (('[]', '["-----BEGIN OPENSSH PRIVATE KEY-----"]'), "is a private key"),
        (('[]', f'["{ED25519[:60]}"]'), "cut or damaged"),
        (('[]', '["ssh-dss AAAA"]'), "starts with 'ssh-dss'"),
        (('[]', f'[\'command="x" {ED25519}\']'), "without options"),
        (('[]', f'["{ED25519}\\nssh-rsa AAAA"]'), "expected one line"),
        (('[]', '["ssh-rsa AAAAB3NzaC1yc2EAAAADAQABAAAAAf8="]'), "of 8 bits; allowed: 2048"),
        (('[payload]', '[payload'), "not valid TOML"),
        (('schema = 1', f'schema = {"[" * 5000}'), "not valid TOML"),
        (('schema = 1', f'schema{".a" * 60_000} = 1'), "a key has more than 32 parts"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_refused_in_one_line(change: tuple[str, str], said: str) -> None:
    assert change[0] in GOOD
    with pytest.raises(DeployError) as caught:
        parse(GOOD.replace(*change, 1).encode())
    line = str(caught.value)
    assert line.startswith("blimp.toml: ") and said in line and "\n" not in line


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (GOOD.encode("utf-16"), "UTF-16"),
        (b"\0" * 512, "NUL"),
        (GOOD.encode() + b"\n# \xff", "line 13 is not UTF-8"),
        (b"#" * 300_000, "300000 bytes"),
        (b"", "'schema' is missing"),
        (GOOD.replace("\n", "\r").encode(), "not valid TOML"),
    ],
)
def test_a_damaged_file_is_refused_in_one_line(data: bytes, said: str) -> None:
    with pytest.raises(DeployError) as caught:
        parse(data)
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_no_error_and_no_repr_tells_the_password() -> None:
    secret = "my secret 🎈"
    assert secret not in repr(_provisioning(password=secret))
    for wrong in (f'"{secret * 9}"', f'["{secret}"]', f'"{secret}\\u0000"'):
        with pytest.raises(DeployError) as caught:
            parse(GOOD.replace('"correct horse"', wrong).encode())
        assert "my secret" not in str(caught.value)


def test_without_secrets_keeps_all_but_the_password_and_says_what_empty_means() -> None:
    made = _provisioning(password="correct horse")
    bare = without_secrets(made)
    assert made.wifi is not None
    assert bare.wifi == dataclasses.replace(made.wifi, password="")
    assert "correct horse" not in render(bare) and "keeps the one that it has" in render(bare)
    assert keeps_password(bare) and not keeps_password(made)
    assert parse(render(bare).encode()) == bare
    cable = Provisioning("blimp-1")
    assert without_secrets(cable) == cable and not keeps_password(cable)


def test_countries_are_those_of_iso_3166() -> None:
    table = Path("/usr/share/zoneinfo/iso3166.tab")
    if not table.exists():
        pytest.skip("no list of ISO 3166 on this machine (tzdata)")
    lines = [line for line in table.read_text().splitlines() if not line.startswith("#")]
    assert {line.split("\t")[0] for line in lines} == CODES


def test_how_deep_a_key_may_be_follows_the_firmware() -> None:
    from deploy.provisioning import text
    from pi_firmware.wire import config

    assert (text.TOO_DEEP, text.DEEPEST) == (config._TOO_DEEP, config._DEEPEST)


def test_names_and_endpoints_follow_the_firmware() -> None:
    from deploy.provisioning import model
    from pi_firmware.wire import keys, telemetry, video

    assert model._PAYLOAD_ID.pattern == keys._PAYLOAD_ID.pattern
    assert (model.VIDEO_PORT, model.TELEMETRY_PORT) == (video.PORT, telemetry.PORT)
    for endpoint in ("tls/10.0.0.1:7447", "tls/[fe80::1]:1", *GroundStation("gs").endpoints):
        assert GroundStation(telemetry=(endpoint,)).telemetry == (endpoint,)
        telemetry.check_endpoint(endpoint, certified=True)
