"""Telemetry messages come back as sent; what is not as agreed is refused in one line."""

import json
from typing import Any

import pytest

from pi_firmware.wire import keys, messages
from pi_firmware.wire.errors import TelemetryError

BATTERY = messages.Battery(time_ns=5, voltage=3.9, percentage=0.5, current=-1.5)
GATE = messages.Gate(
    time_ns=9, capture_ns=8, sequence=3, passed=False, heartbeat=False, entropy_bits=4.5,
    sharpness=10.0, captured=4, gated=1, heartbeats=0, sent=3, ssrc=77,
)  # fmt: skip
HEALTH = messages.Health(time_ns=1, uptime_s=2.0)
EVENT = messages.Event(time_ns=1, name="started", text="up", values={"ssrc": 77})
ROS_BATTERY_STATE = {
    "voltage", "temperature", "current", "charge", "capacity", "design_capacity", "percentage",
    "power_supply_status", "power_supply_health", "power_supply_technology", "present",
}  # fmt: skip


@pytest.mark.parametrize("message", [BATTERY, GATE, EVENT])
def test_a_message_comes_back_as_sent(message: messages.Message) -> None:
    text = messages.encode(message)
    assert messages.decode(type(message), text) == message
    assert json.loads(text)["time_ns"] == message.time_ns
    assert len(text) < 400


def test_battery_has_the_fields_of_ros_battery_state() -> None:
    assert set(json.loads(messages.encode(BATTERY))) >= ROS_BATTERY_STATE | {"schema", "time_ns"}


def changed(message: messages.Message, **fields: Any) -> bytes:
    return json.dumps(json.loads(messages.encode(message)) | fields).encode()


def without(message: messages.Message, name: str) -> bytes:
    document = json.loads(messages.encode(message))
    del document[name]
    return json.dumps(document).encode()


def test_unknown_fields_and_other_minor_versions_are_taken() -> None:
    text = changed(BATTERY, schema="blimp.battery/1.7", cell_voltage=[3.9])
    assert messages.decode(messages.Battery, text) == BATTERY


def test_fields_that_an_older_writer_did_not_send_get_their_default() -> None:
    assert messages.decode(messages.Battery, without(BATTERY, "present")).present is True


@pytest.mark.parametrize(
    ("kind", "text", "named"),
    [
        (messages.Battery, b"\xff\xfe", "not JSON"),
        (messages.Battery, b"[]", "not a JSON object"),
        (messages.Battery, b"[" * 100_000, "not JSON"),
        (messages.Battery, changed(BATTERY, schema="blimp.battery/2.0"), "blimp.battery/2.0"),
        (messages.Gate, messages.encode(BATTERY), "blimp.battery/1.1"),
        (messages.Battery, changed(BATTERY, voltage="3.9"), "'voltage' must be float"),
        (messages.Battery, changed(BATTERY, voltage=float("nan")), "'voltage' must be finite"),
        (messages.Battery, changed(BATTERY, voltage=10**400), "'voltage' must be finite"),
        (messages.Battery, changed(BATTERY, voltage=True), "'voltage' must be float"),
        (messages.Battery, without(BATTERY, "voltage"), "'voltage' is missing"),
        (messages.Gate, changed(GATE, sequence=1.5), "'sequence' must be int"),
        (messages.Gate, changed(GATE, sequence=True), "'sequence' must be int"),
        (messages.Gate, changed(GATE, passed=1), "'passed' must be bool"),
        (messages.Event, changed(EVENT, values=[1]), "'values' must be an object"),
        (messages.Event, changed(EVENT, values={"a": "b"}), "'values'['a'] must be int"),
        (messages.Event, changed(EVENT, values=dict.fromkeys(map(str, range(65)), 1)), "65 items"),
        (messages.Health, changed(HEALTH, late=["a"] * 65), "'late' has 65 items; allowed: 64"),
        (messages.Event, changed(EVENT, values={"a\n" * 99: "b"}), r"'values'['a\na\na"),
    ],
)
def test_a_wrong_message_is_refused_by_name(
    kind: type[messages.Message], text: bytes, named: str
) -> None:
    with pytest.raises(TelemetryError) as caught:
        messages.decode(kind, text)
    assert named in str(caught.value)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 200


def test_a_text_without_end_is_cut() -> None:
    for name in ("name", "text"):
        decoded = messages.decode(messages.Event, changed(EVENT, **{name: "x" * 10_000}))
        assert getattr(decoded, name) == "x" * 1024
    decoded = messages.decode(messages.Event, changed(EVENT, values={"x" * 10_000: 1}))
    assert decoded.values == {"x" * 1024: 1}


def test_a_number_that_is_not_finite_is_never_sent() -> None:
    with pytest.raises(TelemetryError, match="not finite"):
        messages.encode(messages.Battery(time_ns=0, voltage=float("nan")))


def test_keys_are_the_designs() -> None:
    assert keys.key("blimp-1", keys.BATTERY) == "blimp/blimp-1/battery"
    assert keys.every_payload(keys.ALIVE) == "blimp/*/alive"
    assert keys.payload_of("blimp/blimp-1/gate") == "blimp-1"


@pytest.mark.parametrize("payload_id", ["", "*", "a/b", "Blimp", "-a", "a" * 33, "a$b", "é"])
def test_an_id_that_would_break_a_key_is_refused(payload_id: str) -> None:
    with pytest.raises(TelemetryError, match="payload_id"):
        keys.key(payload_id, keys.GATE)


@pytest.mark.parametrize("key", ["blimp/Blimp/gate", "blimp//gate", "blimp/a", "b/a/gate", "", "/"])
def test_a_key_that_is_not_ours_belongs_to_no_payload(key: str) -> None:
    assert keys.payload_of(key) is None
