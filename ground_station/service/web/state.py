"""The state of the station, its metrics, and that it serves at all."""

from __future__ import annotations

import json
from typing import Any

from fastapi import APIRouter, Response

from ground_station.service.web.metrics import CONTENT_TYPE, Metrics
from ground_station.service.web.models import Health, StateModel
from ground_station.service.web.snapshot import Snapshot


def router(snapshot: Snapshot, metrics: Metrics) -> APIRouter:
    """What is told of the station over HTTP."""
    result = APIRouter(tags=["state"])

    @result.get("/api/state", response_model=StateModel)
    def state() -> Any:
        """The whole station, now."""
        # Written as it is: the model describes it, and 2,000 points need no check one by one.
        text = json.dumps(snapshot.document(), separators=(",", ":"), allow_nan=False)
        return Response(text, media_type="application/json")

    @result.get(
        "/metrics",
        response_class=Response,
        responses={200: {"content": {"text/plain": {}}}},
    )
    def all_metrics() -> Response:
        """Prometheus's text format."""
        return Response(metrics.text(), media_type=CONTENT_TYPE)

    @result.get("/healthz", response_model=Health)
    def healthz() -> Any:
        """That this process serves; without a token, and without a word on the station."""
        return {"status": "ok"}

    return result
