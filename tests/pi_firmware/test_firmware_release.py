"""The payload says which version it is and how it came to run, to telemetry and to systemd."""

import json
from typing import Any

import pytest
from flying import Flying
from waiting import eventually

from deploy.board.releases import service
from ground_station.stream.feedback import Feedback
from pi_firmware import __version__, release, supervision
from pi_firmware.release import Release
from pi_firmware.wire import messages

UPDATE = f"{__version__}+gitabcdef012345"


def said(version: Any, how: Any = "update", reason: Any = "") -> dict[str, str]:
    return {release.ENVIRONMENT: json.dumps({"version": version, "how": how, "reason": reason})}


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        ({}, Release()),
        (said(UPDATE), Release(UPDATE, "update")),
        (said("", "factory"), Release(__version__, "factory")),
        (said("9.9.9+gitab"), Release(f"{__version__} in 9.9.9+gitab", "update")),
        (said(UPDATE, "fell back", "no\nframes"), Release(UPDATE, "fell back", "no?frames")),
        (said(UPDATE, "fell back", "x" * 9999), Release(UPDATE, "fell back", "x" * 300)),
        (said(5), Release()),
        (said(UPDATE, None), Release()),
        (said(UPDATE, ["a"]), Release()),
        ({release.ENVIRONMENT: "{"}, Release()),
        ({release.ENVIRONMENT: "[" * 99_999}, Release()),
        ({release.ENVIRONMENT: "[]"}, Release()),
        ({release.ENVIRONMENT: "{}"}, Release()),
    ],
)
def test_the_environment_tells_the_release_or_nothing(
    environment: dict[str, str], expected: Release
) -> None:
    assert release.of_environment(environment) == expected


def test_the_program_tells_its_release_and_why_an_update_did_not_stay(
    flying: Flying, monkeypatch: pytest.MonkeyPatch
) -> None:
    flying.environment |= said(UPDATE, "fell back", "0.2.0+gitbad: no frames within 120 s")
    flying.start("camera.uri=test:", "camera.rate_hz=10")
    state = flying.state(lambda s: s.health is not None and s.gate is not None)
    assert state.health is not None
    told = (state.health.version, state.health.release, state.health.release_reason)
    assert told == (UPDATE, "fell back", "0.2.0+gitbad: no frames within 120 s")
    started = next(e for e in state.events if e.name == messages.EVENT_STARTED)
    assert UPDATE in started.text and "no frames within 120 s" in started.text
    before = f"STATUS=version {UPDATE} (fell back): 0.2.0+gitbad: no frames within 120 s; telemetry"
    lines = flying.said()
    with Feedback(flying.listener, lambda payload_id: flying.receiver):
        eventually(lambda: f"{before} up" in lines, step=lambda: lines.extend(flying.said()))
    # What tries out a release on the card reads this very line.
    assert supervision.TELEMETRY_UP == service.TELEMETRY_UP
    assert supervision.ARMED == service.ARMED
    told_systemd = [line for line in lines if line.startswith("STATUS=")]
    assert told_systemd in ([f"{before} down", f"{before} up"], [f"{before} up"])
    assert lines.index("READY=1") < lines.index(told_systemd[0])
    flying.end()
