"""The station's state over HTTP, and in Prometheus's terms: its notes and its latencies.

Names follow Prometheus's conventions (base units, `_total` for counters). What notes tell is read
at each scrape; labels are bounded as the snapshot is.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from fastapi import APIRouter, Response
from prometheus_client import (
    CollectorRegistry,
    Counter,
    Histogram,
    Summary,
    disable_created_metrics,
)
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    InfoMetricFamily,
    Metric,
)
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4, generate_latest
from prometheus_client.registry import Collector

from ground_station.localization.estimate import State
from ground_station.service.bus_messages import EstimateMessage
from ground_station.service.web.models import Health, StateModel
from ground_station.service.web.snapshot import Snapshot

_SECONDS = (
    0.005, 0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.08, 0.1, 0.15, 0.2, 0.3, 0.5, 1.0, 2.0, 5.0,
)  # fmt: skip
_STAGES = 24
_LATENCY_LIMIT_S = 60.0

_GAUGES = (
    # name, of which message, its field, help
    ("battery_volts", "battery", "voltage", "Battery voltage."),
    ("battery_amperes", "battery", "current", "Battery current, negative when discharging."),
    ("battery_ratio", "battery", "percentage", "Battery charge, 0 to 1."),
    ("battery_left_seconds", "battery", "time_left_s", "Until the battery's critical voltage."),
    ("payload_temperature_celsius", "health", "temperature_C", "Of the payload's processor."),
    ("payload_cpu_ratio", "health", "cpu", "Share of all the payload's cores in use."),
    ("payload_wifi_signal_dbm", "health", "wifi_signal_dBm", "Wi-Fi signal at the payload."),
)


class Metrics(Collector):
    """All metrics of the station, in a registry of their own. Safe from any thread."""

    def __init__(self, snapshot: Snapshot) -> None:
        disable_created_metrics()  # text format 0.0.4 has no place for them but series of their own
        self.registry = CollectorRegistry()
        self.answers = Counter(
            "blimp_http_answers", "HTTP answers.", ["method", "status"], registry=self.registry
        )
        self.viewers: Callable[[], int] = lambda: 0
        self.bus_dropped: Callable[[], int] = lambda: 0
        self.video: Callable[[], Mapping[str, int]] = dict
        self._snapshot = snapshot
        self._stages = Summary(
            "blimp_stage_seconds", "Time of the localizer's stages.", ["payload", "stage"],
            registry=self.registry,
        )  # fmt: skip
        self._to_pose = Histogram(
            "blimp_capture_to_pose_seconds",
            "From a frame's capture to its pose, frames with a known capture time only.",
            ["payload"], buckets=_SECONDS, registry=self.registry,
        )  # fmt: skip
        self._to_screen = Histogram(
            "blimp_capture_to_screen_seconds",
            "From a frame's capture to its picture on a viewer's screen, as viewers report it.",
            ["payload"], buckets=_SECONDS, registry=self.registry,
        )  # fmt: skip
        self.pictures_sent = Counter(
            "blimp_viewer_pictures_sent", "Pictures handed to viewers.", registry=self.registry
        )
        self.pictures_lost = Counter(
            "blimp_viewer_pictures_lost",
            "Pictures that viewers who left were too slow to take.",
            registry=self.registry,
        )
        self.registry.register(self)

    def estimate(self, payload_id: str, note: EstimateMessage) -> None:
        """Counts a pose's latency and the time of its stages."""
        if payload_id not in self._snapshot.payload_ids():
            return
        if note.capture_ns is not None and note.position_m is not None:
            seconds = 1e-9 * (note.done_ns - note.capture_ns)
            if 0 <= seconds <= _LATENCY_LIMIT_S:  # else a clock was stepped in between
                self._to_pose.labels(payload_id).observe(seconds)
        for stage, spent_ms in list(note.stage_ms.items())[:_STAGES]:
            self._stages.labels(payload_id, stage[:32]).observe(1e-3 * spent_ms)

    def shown(self, payload_id: str, seconds: float) -> None:
        """A viewer saw a picture this long after its capture."""
        if payload_id in self._snapshot.payload_ids():
            self._to_screen.labels(payload_id).observe(seconds)

    def forget(self, payload_id: str) -> None:
        """A payload is forgotten; so are its series."""
        for metric in (self._to_pose, self._to_screen, self._stages):
            metric.remove_by_labels({"payload": payload_id})

    def text(self) -> bytes:
        """Everything in Prometheus's text format 0.0.4."""
        return generate_latest(self.registry)

    def collect(self) -> Iterator[Metric]:
        """What the notes say, read at each scrape."""
        state = self._snapshot.document(full=False)
        yield from _of_station(state)
        yield from _of_payloads(state["payloads"])
        yield from _of_processes(state["processes"])
        yield GaugeMetricFamily("blimp_viewers", "Live connections.", value=self.viewers())
        yield CounterMetricFamily(
            "blimp_bus_dropped",
            "What this process heard on the bus that was no message.",
            value=self.bus_dropped(),
        )
        pictures = CounterMetricFamily(
            "blimp_pictures", "Frames that viewers wanted, by what became of them.", labels=["fate"]
        )
        for fate, count in self.video().items():
            pictures.add_metric([fate], count)
        yield pictures


def _of_station(state: Mapping[str, Any]) -> Iterator[Metric]:
    station = state["station"]
    about = {name: str(station[name]) for name in ("name", "version", "map")}
    yield InfoMetricFamily("blimp_station", "This station.", about)
    alarms = GaugeMetricFamily(
        "blimp_alarm", "1 for each alarm that stands.", labels=["alarm", "level", "payload"]
    )
    for alarm in state["alarms"]:
        alarms.add_metric([alarm["id"][:64], alarm["level"], alarm["payload"]], 1)
    yield alarms
    if (recording := state["recording"]) is None:
        return
    free_MB = recording["free_MB"]
    yield GaugeMetricFamily(
        "blimp_recording_active", "1 while the station records.", value=recording["active"]
    )
    yield GaugeMetricFamily(
        "blimp_recording_free_bytes",
        "Free on the recordings' disk.",
        value=None if free_MB is None else 1e6 * free_MB,
    )
    yield CounterMetricFamily(
        "blimp_recording_dropped",
        "Messages of this recording that a slow disk did not take.",
        value=recording["dropped"],
    )


def _of_payloads(payloads: Mapping[str, Any]) -> Iterator[Metric]:
    up = GaugeMetricFamily("blimp_payload_up", "1 while it is heard.", labels=["payload"])
    frames = CounterMetricFamily(
        "blimp_frames", "Frames by fate, as payload, receiver and localizer count them.",
        labels=["payload", "fate"],
    )  # fmt: skip
    stream = CounterMetricFamily(
        "blimp_stream", "The receiver's counters.", labels=["payload", "counter"]
    )
    states = GaugeMetricFamily(
        "blimp_state", "1 for the localizer's state, 0 for the others.", labels=["payload", "state"]
    )
    lost = GaugeMetricFamily(
        "blimp_packets_lost_ratio", "Share of the video's packets lost of late.", labels=["payload"]
    )
    rate = GaugeMetricFamily(
        "blimp_video_bits_per_second", "Video as received.", labels=["payload"]
    )
    values = {
        name: GaugeMetricFamily(f"blimp_{name}", text, labels=["payload"])
        for name, _, _, text in _GAUGES
    }
    for payload_id, view in payloads.items():
        up.add_metric([payload_id], view["alive"])
        if (estimate := view["estimate"]) is not None:
            for state in State:
                states.add_metric([payload_id, state.value], estimate["state"] == state.value)
            for fate in ("processed", "localized", "skipped"):
                frames.add_metric([payload_id, fate], estimate[fate])
        if (note := view["payload"]) is None:
            continue
        for family, table in ((frames, note["frames"]), (stream, note["stream"])):
            for name, count in list(table.items())[:32]:
                family.add_metric([payload_id, name[:32]], count)
        lost.add_metric([payload_id], note["lost_share"])
        rate.add_metric([payload_id], 1e3 * note["bitrate_kbps"])
        for name, message, field, _ in _GAUGES:
            if note[message] and message not in view["stale"]:
                value = note[message][field]
                if value is not None:
                    values[name].add_metric([payload_id], value)
    yield from (up, states, frames, stream, lost, rate, *values.values())


def _of_processes(processes: list[Mapping[str, Any]]) -> Iterator[Metric]:
    memory = GaugeMetricFamily(
        "blimp_process_resident_bytes", "Resident memory.", labels=["process"]
    )
    cpu = GaugeMetricFamily("blimp_process_cpu_ratio", "Of one core.", labels=["process"])
    silent = GaugeMetricFamily(
        "blimp_process_silent_seconds", "Since it last said that it lives.", labels=["process"]
    )
    restarts = CounterMetricFamily(
        "blimp_process_restarts", "Times it was restarted.", labels=["process"]
    )
    for process in processes:
        name = [process["name"][:64]]
        memory.add_metric(name, 1e6 * process["memory_MB"])
        cpu.add_metric(name, process["cpu"])
        silent.add_metric(name, process["age_s"])
        restarts.add_metric(name, process["restarts"])
    yield from (memory, cpu, silent, restarts)


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
        return Response(metrics.text(), media_type=CONTENT_TYPE_PLAIN_0_0_4)

    @result.get("/healthz", response_model=Health)
    def healthz() -> Any:
        """That this process serves; without a token, and without a word on the station."""
        return {"status": "ok"}

    return result
