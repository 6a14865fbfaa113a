"""The battery: gauges chosen by URI, state of charge, and what happens when it runs low."""

from pi_firmware.battery.gauges import open_gauge
from pi_firmware.battery.monitor import Monitor

__all__ = ["Monitor", "open_gauge"]
