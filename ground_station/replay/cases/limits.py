"""The bounds that a run can be held to, for all payload kinds or one."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from ground_station.evaluation.figures import AT_LEAST, AT_MOST
from pi_firmware.wire.config import key, table


def _bound(doc: str, unit: str, high: float | None = None) -> Any:
    return key(None, doc, unit=unit, low=0.0, high=high)


@dataclass(frozen=True)
class Limits:
    """What a run must hold; what is left out is measured and not judged."""

    coverage_min: float | None = _bound("localized frames, of those sent", "share", 1.0)
    tracking_min: float | None = _bound(
        "frames called TRACKING, of those that reached the localizer", "share", 1.0
    )
    lost_max: float | None = _bound("frames lost, of those sent", "share", 1.0)
    position_rmse_m_max: float | None = _bound("position error, RMSE, unaligned", "m")
    rotation_rmse_deg_max: float | None = _bound("rotation error, RMSE", "°", 180.0)
    position_max_m: float | None = _bound("worst position error of a pose called TRACKING", "m")
    latency_p50_ms_max: float | None = _bound("capture to pose, median", "ms")
    latency_p99_ms_max: float | None = _bound("capture to pose, 99th percentile", "ms")
    recovery_s_max: float | None = _bound(
        "from an outage's end to the first TRACKING pose of a frame taken after it", "s"
    )
    payload_memory_MB_max: float | None = _bound("the firmware's resident memory, peak", "MB")
    ground_memory_MB_max: float | None = _bound("the ground station's resident memory, peak", "MB")
    payload_cpu_max: float | None = _bound(
        "the firmware's processor time, of one core (of a board, from telemetry: of all cores)",
        "share", 64.0,
    )  # fmt: skip
    battery_V_min: float | None = _bound("the cell's voltage, as telemetry says it", "V", 60.0)
    battery_V_max: float | None = _bound("the same, from above", "V", 60.0)
    identical: bool = key(False, "stepped only: a second run gives the same poses, bit for bit")


NAMES = tuple(item.name for item in dataclasses.fields(Limits))
BOUNDS: list[tuple[str, str, str, str]] = [
    (
        item.name,
        "tracking_worst_m" if item.name == "position_max_m" else item.name[: -len("_max")],
        item.metadata["unit"],
        AT_LEAST if item.name.endswith("_min") else AT_MOST,
    )
    for item in dataclasses.fields(Limits)
    if item.name != "identical"
]
"""Of each bound its name, its figure, unit and sense; the figure without the bound's suffix."""


@dataclass(frozen=True)
class KindLimits(Limits):
    """Bounds of one payload kind: each key in place of the same one in [bounds]."""

    drop: list[str] = key([], "bounds of [bounds] that are not judged here", choices=NAMES)


@dataclass(frozen=True)
class Bounds(Limits):
    """The bounds of all payload kinds, and those of emulated and real boards."""

    image: KindLimits = table(KindLimits)
    ssh: KindLimits = table(KindLimits)

    def __post_init__(self) -> None:
        for place, own in (("", self), ("image.", self.image), ("ssh.", self.ssh)):
            low, high = own.battery_V_min, own.battery_V_max
            if low is not None and high is not None and low > high:
                raise ValueError(
                    f"'bounds.{place}battery_V_min' is {low:g} V; allowed: at most battery_V_max,"
                    f" {high:g} V"
                )

    def of(self, kind: str) -> Limits:
        """What is judged on a payload kind."""
        values: dict[str, Any] = {name: getattr(self, name) for name in NAMES}
        own = getattr(self, kind, None)
        if isinstance(own, KindLimits):
            given = {name: getattr(own, name) for name in NAMES}
            # By identity: a bound of 0 is a bound.
            values |= {k: v for k, v in given.items() if v is not None and v is not False}
            values |= {name: False if name == "identical" else None for name in own.drop}
        return Limits(**values)
