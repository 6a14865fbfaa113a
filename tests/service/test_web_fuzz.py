"""The whole API under schemathesis: whatever is sent, no answer is a 5xx, and each is described."""

from __future__ import annotations

import contextlib
from collections import Counter
from pathlib import Path

import schemathesis
from hypothesis import HealthCheck, given, settings
from hypothesis.errors import Unsatisfiable
from schemathesis import GenerationMode
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)

CHECKS = [
    not_a_server_error,
    status_code_conformance,
    content_type_conformance,
    response_schema_conformance,
]


def fuzz(operation, mode, answered: Counter[str]) -> None:
    @settings(
        max_examples=10,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(case=operation.as_strategy(generation_mode=mode))
    def ask(case):
        answer = case.call()
        case.validate_response(answer, checks=CHECKS)
        answered[f"{operation.label} {answer.status_code}"] += 1

    with contextlib.suppress(Unsatisfiable):  # nothing about it can be wrong
        ask()


def test_no_request_makes_the_station_fail(unchanged):
    _, bus, web = unchanged
    folder = Path(web.snapshot.run.station.recording.folder)
    (folder / "a.mcap").write_bytes(b"no recording")
    schema = schemathesis.openapi.from_asgi("/api/openapi.json", web.guarded)
    answered: Counter[str] = Counter()
    operations = [found.ok() for found in schema.get_all_operations()]
    for operation in operations:
        for mode in (GenerationMode.POSITIVE, GenerationMode.NEGATIVE):
            fuzz(operation, mode, answered)
    assert {label.rpartition(" ")[0] for label in answered} == {item.label for item in operations}
    # It came through to what answers, and not only to what refuses.
    for path in ("GET /api/state", "POST /api/recording", "GET /api/maps"):
        assert answered[f"{path} 200"], answered
    assert len(operations) >= 14 and bus.asked
