"""`wpa_supplicant.conf`: the standard's keys, and bytes that the real program reads as they are."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from deploy.errors import DeployError
from deploy.provisioning.model import Provisioning, Wifi, without_secrets
from deploy.provisioning.text import parse, render
from deploy.provisioning.wpa import psk, wpa_supplicant_conf

SUPPLICANT = shutil.which("wpa_supplicant", path="/usr/sbin:/sbin:/usr/bin:/usr/local/sbin")


def _made(ssid: bytes = b"hall", password: str = "correct horse", **more: object) -> Provisioning:
    return Provisioning("blimp-1", Wifi(ssid, "DE", password, **more))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("password", "ssid", "key"),
    [
        ("password", b"IEEE", "f42c6fc52df0ebef9ebb4b90b38a5f902e83fe1b135a70e23aed762e9710a12e"),
        (
            "ThisIsAPassword",
            b"ThisIsASSID",
            "0dc0d6eb90555ed6419756b9a15ec3e3209b63df707dd508d14581f8982721af",
        ),
        (
            "a" * 32,
            b"Z" * 32,
            "becb93866bb8c3832cb777c2f559807c8c59afcb6eae734885001300a981cc62",
        ),
    ],
)
def test_keys_are_those_of_the_standard(password: str, ssid: bytes, key: str) -> None:
    """The three test vectors of IEEE 802.11i-2004, H.4.3."""
    assert psk(password, ssid) == key
    conf = wpa_supplicant_conf(_made(ssid, password))
    assert f"psk={key}" in conf and password not in conf


def test_a_key_given_as_digits_is_taken_as_it_is() -> None:
    assert f"psk={'ab' * 32}\n" in wpa_supplicant_conf(_made(password="Ab" * 32))
    with pytest.raises(DeployError, match=r"has 64 bytes; allowed: 8 to 63 bytes$"):
        _made(password="ab" * 32, security="wpa3")


def test_no_character_of_a_name_or_password_stands_in_the_file() -> None:
    hostile = 'x"\n}\nnetwork={$(id)'
    for security in ("wpa2", "wpa3"):
        conf = wpa_supplicant_conf(_made(hostile.encode(), hostile, security=security))
        assert conf.count("network={") == 1 and "$(" not in conf and '"' not in conf
        assert all(re.fullmatch(r"[ -~]*", line) for line in conf.splitlines())
        assert f"ssid={hostile.encode().hex()}\n" in conf


def test_open_hidden_and_none() -> None:
    conf = wpa_supplicant_conf(_made(password="", security="open", hidden=True))
    assert "key_mgmt=NONE" in conf and "scan_ssid=1" in conf and "psk" not in conf
    assert "scan_ssid" not in wpa_supplicant_conf(_made())
    assert wpa_supplicant_conf(Provisioning("blimp-1")) == ""


@pytest.mark.parametrize("security", ["wpa2", "wpa3"])
def test_an_empty_password_keeps_the_stored_one_of_the_same_network(security: str) -> None:
    made = _made(security=security)
    stored = wpa_supplicant_conf(made)
    bare = parse(render(without_secrets(made)).encode())
    assert wpa_supplicant_conf(bare, stored) == stored
    other_security = "wpa3" if security == "wpa2" else "wpa2"
    for wrong in ("", "garbage", stored[:60]):
        with pytest.raises(DeployError, match="the card holds none for this network"):
            wpa_supplicant_conf(bare, wrong)
    for other in (_made(b"other", ""), _made(password="", security=other_security)):
        with pytest.raises(DeployError, match="write it again"):
            wpa_supplicant_conf(other, stored)


NAMES = [b"hall", b'q" $(id) \\ \n}', "ünï 🎈".encode(), bytes(range(32)), b"\xff\xfe"]


@pytest.mark.parametrize("security", ["wpa2", "wpa3", "open"])
@pytest.mark.parametrize("ssid", NAMES)
def test_the_real_program_reads_the_same_bytes(tmp_path: Path, security: str, ssid: bytes) -> None:
    """On an interface that does not exist: it reads the file, says what it read, and ends."""
    if SUPPLICANT is None:
        pytest.skip("no wpa_supplicant on this machine (wpasupplicant)")
    password = "" if security == "open" else 'a "quoted" $(id)\n🎈 }'
    made = _made(ssid, password, security=security, hidden=True)
    conf = wpa_supplicant_conf(made).replace("/run/wpa_supplicant", str(tmp_path / "control"))
    file = tmp_path / "wpa_supplicant.conf"
    file.write_text(conf)
    done = subprocess.run(
        [SUPPLICANT, "-dd", "-K", "-Dwired", "-inone0", f"-c{file}"],
        capture_output=True, text=True, errors="replace", timeout=20, check=False,
    )  # fmt: skip
    said = done.stdout + done.stderr
    assert "start of a new network block" in said, said
    assert "Failed to read or parse" not in said and "unknown" not in said.lower(), said
    assert _dumped(said, "ssid") == ssid
    assert "country='DE'" in said and "scan_ssid=1" in said
    protected, required = "pmf=1" in said.splitlines(), "ieee80211w=2" in said
    assert protected and required is (security == "wpa3")
    keys = {"open": "0x4", "wpa2": "0x102", "wpa3": "0x400"}  # none, PSK and PSK-SHA256, SAE
    assert f"key_mgmt: {keys[security]}\n" in said, said
    if security == "wpa3":
        assert _dumped(said, "sae_password") == password.encode()
    elif security == "wpa2":
        assert bytes.fromhex(_line_of(said, "PSK - hexdump")) == bytes.fromhex(psk(password, ssid))


def _dumped(said: str, name: str) -> bytes:
    """The bytes of one `hexdump_ascii`, whose lines begin with blanks."""
    lines = said.splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith(f"{name} - hexdump_ascii"))
    data = b""
    for line in lines[start + 1 :]:
        if not line.startswith("     "):
            break
        data += bytes.fromhex(line[5:53])
    return data


def _line_of(said: str, start: str) -> str:
    line = next(line for line in said.splitlines() if line.startswith(start))
    return line.partition("): ")[2]
