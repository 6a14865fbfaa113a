"""Whether what the payload said of battery and health is there, in range and a number."""

from __future__ import annotations

import math
from typing import Any

Range = tuple[float, float]

BATTERY: dict[str, Range] = {
    "voltage": (1.0, 60.0),
    "percentage": (0.0, 1.0),
    "current": (-100.0, 100.0),
    "charge": (0.0, 1000.0),
    "capacity": (0.0, 1000.0),
    "temperature": (-60.0, 120.0),
    "time_left_s": (0.0, 1e6),
    "read_errors": (0.0, math.inf),
    "refused": (0.0, math.inf),
}
"""What a cell of any blimp can have; V, share, A, Ah, °C, s."""
HEALTH: dict[str, Range] = {
    "uptime_s": (0.0, math.inf),
    "captured": (0.0, math.inf),
    "gated": (0.0, math.inf),
    "sent": (0.0, math.inf),
    "discarded": (0.0, math.inf),
    "rate_hz": (0.0, 1000.0),
    "bitrate_kbps": (0.0, 1e6),
    "lost": (0.0, 1.0),
    "round_trip_s": (0.0, 3600.0),
    "temperature_C": (-60.0, 150.0),
    "cpu": (0.0, 1.0),
    "memory_MB": (0.0, 1e6),
    "memory_free_MB": (0.0, 1e7),
    "disk_free_MB": (0.0, 1e9),
    "wifi_signal_dBm": (-130.0, 30.0),
    "wifi_quality": (0.0, 1.0),
}
_NEEDED = {"battery": ("voltage", "time_ns"), "health": ("uptime_s", "time_ns")}


def trouble(kind: str, message: dict[str, Any] | None, ranges: dict[str, Range]) -> str:
    """What is wrong with a message of a kind, in words; "" when nothing is."""
    if message is None:
        return f"no {kind} message came"
    for name in _NEEDED[kind]:
        if message.get(name) is None:
            return f"{name} is missing"
    for name, value in message.items():
        if isinstance(value, float) and not math.isfinite(value):
            return f"{name} is {value}"
    for name, (low, high) in ranges.items():
        value = message.get(name)
        if value is None:
            continue
        if isinstance(value, bool) or not isinstance(value, int | float):
            return f"{name} is {str(value)[:40]!r}, not a number"
        if not low <= value <= high:
            return f"{name} is {str(value)[:24]}; allowed: {low:g} to {high:g}"
    return ""
