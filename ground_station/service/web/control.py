"""What changes something: commands to payloads, maps, recording. Others carry it out."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

from fastapi import APIRouter

from ground_station.service.bus import Bus
from ground_station.service.fleet.fleet import Fleet
from ground_station.service.web.maps import Maps
from ground_station.service.web.models import (
    AnswerModel,
    CommandRequest,
    MapName,
    MapRequest,
    PayloadId,
    RecordingRequest,
    StationName,
    StationRequest,
)
from ground_station.service.web.problems import Busy, NotFound, problems
from ground_station.service.web.snapshot import Snapshot

_AT_ONCE = 8
_TIMEOUT_S = 7.0
INTAKE = "intake"


class Control:
    """Asks the service's processes, a few at a time."""

    def __init__(self, bus: Bus | Fleet, snapshot: Snapshot) -> None:
        self._bus, self._snapshot = bus, snapshot
        self._free = threading.BoundedSemaphore(_AT_ONCE)

    def ask(self, name: str, request: Mapping[str, Any]) -> dict[str, Any]:
        """The answer, which may be a refusal with its reason; raises `Busy`."""
        if not self._free.acquire(blocking=False):
            raise Busy(f"{_AT_ONCE} requests wait for an answer already")
        try:
            answer = self._bus.query(name, request, timeout_s=_TIMEOUT_S)
        finally:
            self._free.release()
        values = answer.get("values")
        if not isinstance(values, dict):
            values = {key: answer[key] for key in answer if key not in ("done", "reason", "values")}
        return {
            "done": bool(answer.get("done")),
            "reason": str(answer.get("reason", ""))[:500],
            "values": values,
        }

    def check_payload(self, payload_id: str) -> None:
        """Raises `NotFound` for one that was never seen."""
        if payload_id not in self._snapshot.payload_ids():
            raise NotFound(f"there is no payload {payload_id!r}")


def router(control: Control, maps: Maps, fleet: Fleet | None = None) -> APIRouter:
    """Control over HTTP."""
    result = APIRouter(prefix="/api", tags=["control"])

    @result.post(
        "/payloads/{payload_id}/command", response_model=AnswerModel, responses=problems(404, 413)
    )
    def command(payload_id: PayloadId, request: CommandRequest) -> Any:
        """Asks a payload to do something."""
        control.check_payload(payload_id)
        return control.ask(
            INTAKE,
            {
                "do": "payload-command",
                "payload": payload_id,
                "name": request.name,
                "arguments": request.arguments,
            },
        )

    @result.post(
        "/payloads/{payload_id}/relocalize", response_model=AnswerModel, responses=problems(404)
    )
    def relocalize(payload_id: PayloadId) -> Any:
        """Forgets the pose and searches the whole map."""
        control.check_payload(payload_id)
        return control.ask(f"localizer/{payload_id}", {"do": "relocalize"})

    @result.post(
        "/payloads/{payload_id}/map", response_model=AnswerModel, responses=problems(404, 413)
    )
    def choose_map(payload_id: PayloadId, request: MapRequest) -> Any:
        """Localizes in another map from now on."""
        control.check_payload(payload_id)
        if request.name not in maps.names():
            raise NotFound(f"there is no map {request.name!r}")
        return control.ask(f"localizer/{payload_id}", {"do": "map", "name": request.name})

    @result.post(
        "/payloads/{payload_id}/station", response_model=AnswerModel, responses=problems(404, 413)
    )
    def choose_station(payload_id: PayloadId, request: StationRequest) -> Any:
        """Has a payload fly with a station, and stay there."""
        control.check_payload(payload_id)
        known = fleet is not None and (
            request.name in ("", fleet.name) or fleet.where.knows(request.name)
        )
        if fleet is None or not known:
            raise NotFound(f"no station {request.name!r} flies beside this one")
        fleet.pin(payload_id, request.name)
        return {"done": True, "reason": "", "values": {}}

    @result.post(
        "/stations/{station}/maps/{name}", response_model=AnswerModel, responses=problems(404, 409)
    )
    def fetch_map(station: StationName, name: MapName) -> Any:
        """Takes a map that another station offers; `values.map` is what it is called here."""
        if fleet is None or not fleet.where.knows(station):
            raise NotFound(f"no station {station!r} flies beside this one")
        return {"done": True, "reason": "", "values": {"map": fleet.fetch_map(station, name)}}

    @result.post("/recording", response_model=AnswerModel, responses=problems(413))
    def recording(request: RecordingRequest) -> Any:
        """Starts or stops the station's own recording."""
        return control.ask(INTAKE, {"do": "record-start" if request.active else "record-stop"})

    return result
