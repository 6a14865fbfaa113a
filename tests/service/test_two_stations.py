"""Two stations of one authority in one network: each payload flies with one of them."""

from __future__ import annotations

import json
from pathlib import Path

from intake_stand import eventually
from standing import Service

PAYLOAD = "blimp-1"
_LIMIT_S = 90.0


def alarms(service: Service) -> dict[str, str]:
    """What its alarms say, by id."""
    return {alarm["id"]: alarm["text"] for alarm in service.state()["alarms"]}


def test_a_payload_whose_station_dies_flies_on_with_the_other(tmp_path: Path) -> None:
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
    first = Service(tmp_path / "first")
    second = Service(tmp_path / "second", name="spare", authority=first.authority)
    endpoints = json.dumps([first.endpoint, second.endpoint])
    both = {"main": first, "spare": second}
    with (
        first,
        second,
        first.fly(
            PAYLOAD, tmp_path / "payload", "link.host=auto", f"telemetry.connect={endpoints}",
            rate_hz=10.0,
        ),
    ):  # fmt: skip

        def flies_with() -> str:
            return next((name for name, one in both.items() if one.tracking(PAYLOAD)), "")

        eventually(lambda: flies_with() != "", _LIMIT_S)
        name = flies_with()
        used, other = both.pop(name), *both.values()
        assert other.payload(PAYLOAD)["payload"]["frames"]["received"] == 0
        eventually(lambda: other.payload(PAYLOAD)["payload"]["station"] == name, _LIMIT_S)
        eventually(lambda: f"elsewhere/{PAYLOAD}" in alarms(other), _LIMIT_S)
        assert f"station '{name}'" in alarms(other)[f"elsewhere/{PAYLOAD}"]
        eventually(lambda: f"no-frames/{PAYLOAD}" not in alarms(other), _LIMIT_S)
        used.kill()
        eventually(lambda: other.tracking(PAYLOAD), _LIMIT_S)
        eventually(lambda: f"elsewhere/{PAYLOAD}" not in alarms(other), _LIMIT_S)
