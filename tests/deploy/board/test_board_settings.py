"""payload.toml out of four: what wins, and that what is written reads as the same."""

from __future__ import annotations

import tomllib
from typing import Any

import pytest
from board_cards import BLIMP
from hypothesis import given
from hypothesis import strategies as st

from deploy.board import settings
from deploy.errors import DeployError
from deploy.provisioning.model import GroundStation, Provisioning

TEXTS = st.text(st.characters(exclude_categories=["Cs"]), max_size=12)
SCALARS = TEXTS | st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False)
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXTS, inner, max_size=3),
    max_leaves=12,
)


@given(st.dictionaries(TEXTS, VALUES, max_size=5))
def test_what_is_dumped_reads_as_the_same(document: dict[str, Any]) -> None:
    text = settings.dump(document)
    assert tomllib.loads(text) == document
    assert settings.read(text.encode(), "x") == document


@pytest.mark.parametrize("text", ["nan = nan", "up = inf", "down = -inf", "tiny = 1e-300"])
def test_numbers_at_the_edge_stay(text: str) -> None:
    document = tomllib.loads(text)
    assert repr(tomllib.loads(settings.dump(document))) == repr(document)


def test_later_ones_win_key_by_key() -> None:
    board = {"camera": {"uri": "libcamera:", "rate_hz": 30.0}, "gate": {"enabled": True}}
    user = {
        "payload_id": "forged",
        "camera": {"rate_hz": 20.0},
        "link": {"host": "192.0.2.66", "mtu_bytes": 1200},
        "telemetry": {"certificates": "/elsewhere", "discover": "usb0", "connect": ["tls/a:1"]},
    }
    document = settings.merged(board, user, BLIMP, "/data/blimp/certificates")
    assert document == {
        "payload_id": "blimp-1",
        "camera": {"uri": "libcamera:", "rate_hz": 20.0},
        "gate": {"enabled": True},
        "link": {"host": "auto", "port": 5600, "mtu_bytes": 1200},
        "telemetry": {
            "certificates": "/data/blimp/certificates",
            "connect": [],
            "discover": "usb0",
        },
    }
    assert board["camera"]["rate_hz"] == 30.0 and user["payload_id"] == "forged"


def test_a_station_that_is_named_is_not_looked_for() -> None:
    named = Provisioning("b", BLIMP.wifi, GroundStation("192.0.2.1", 5601, ("tls/192.0.2.1:7000",)))
    document = settings.merged({}, {}, named, "/c")
    assert document["link"] == {"host": "192.0.2.1", "port": 5601}
    assert document["telemetry"] == {"connect": ["tls/192.0.2.1:7000"], "certificates": "/c"}
    looked_for = settings.merged({}, {}, Provisioning("b"), "/c")
    assert looked_for["telemetry"]["discover"] == "eth0"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (b"a = 2026-01-01", "payload.toml: 'a' is a date, which no key takes"),
        (b"[a]\nb = [12:00:00]", "payload.toml: 'a.b' is a time, which no key takes"),
        (b"a = 0x" + b"f" * 40, "payload.toml: 'a' is a number of 160 bits"),
    ],
)
def test_what_no_configuration_holds_is_refused(text: bytes, told: str) -> None:
    with pytest.raises(DeployError) as error:
        settings.dump(settings.read(text, "payload.toml"))
    assert str(error.value) == told


@pytest.mark.parametrize("text", [b"\xff\xfe", b"a = 1\na = 2\n", b"a" * 100, b"[[" * 5000,
                                  b"a." * 60_000 + b"b = 1"])  # fmt: skip
def test_what_is_no_toml_is_one_line(text: bytes) -> None:
    with pytest.raises(DeployError) as error:
        settings.read(text, "payload.toml")
    said = str(error.value)
    assert said.startswith("payload.toml: ") and " not " in said and "\n" not in said
