"""The whole API under schemathesis: whatever is sent, no answer is a 5xx, and each is described."""

from __future__ import annotations

import contextlib
from collections import Counter

import pytest
import schemathesis
import web_station as station
from hypothesis import HealthCheck, given, settings
from hypothesis.errors import Unsatisfiable
from schemathesis import GenerationMode
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)

from ground_station.service.web.access import Buckets
from ground_station.service.web.app import build

CHECKS = [
    not_a_server_error,
    status_code_conformance,
    content_type_conformance,
    response_schema_conformance,
]


@pytest.fixture(scope="module")
def api(tmp_path_factory):
    folder = tmp_path_factory.mktemp("web")
    bus = station.SilentBus()
    web = build(station.run_of(folder), folder, bus, None)
    web.access.posts = Buckets(1e9, 10**9)  # it is the API that is asked here, not its bounds
    with station.TestClient(web.guarded, "http://127.0.0.1:8080"):
        station.say_all(bus.put)
        (folder / "recordings" / "a.mcap").write_bytes(b"no recording")
        yield schemathesis.openapi.from_asgi("/api/openapi.json", web.guarded), bus


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


def test_no_request_makes_the_station_fail(api):
    schema, bus = api
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
