"""The board's state from the kernel's files: no program is run, and nothing here raises."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

from pi_firmware.health import small_files
from pi_firmware.wire.messages import UNDERVOLTAGE, WAS

_CPU_ZONES = ("cpu", "soc", "bcm2", "x86_pkg")  # bcm2835_thermal is the Pi's in older kernels
_COLDEST_C, _HOTTEST_C = -60.0, 150.0  # no silicon that still counts is outside
_CPU = re.compile(r"cpu +([0-9]{1,18}(?: [0-9]{1,18})*)\n", re.ASCII)
_IDLE, _IOWAIT, _STEAL = 3, 4, 7  # columns of /proc/stat; guest time, beyond, is in user's already
_AVAILABLE = re.compile(r"^MemAvailable: +([0-9]{1,12}) kB$", re.ASCII | re.MULTILINE)
_STATM = re.compile(r"[0-9]{1,12} ([0-9]{1,12}) ", re.ASCII)
_HEX = re.compile(r"(?:0x)?[0-9a-fA-F]{1,8}", re.ASCII)
_MB = 1e6

# The Pi firmware's bits of now (raspberrypi.com, `vcgencmd get_throttled`); 16 higher stands the
# same for what has been since power-on, or since the kernel's voltage driver last cleared it.
_BITS = {0: UNDERVOLTAGE, 1: "frequency-capped", 2: "throttled", 3: "soft-temperature-limit"}
_WAS_SHIFT = 16


@dataclass(frozen=True)
class BoardState:
    """Fields of the health message by their names; None: this board cannot tell."""

    temperature_C: float | None = None  # the hottest zone of the processor
    cpu: float | None = None  # share of all cores since the last reading, 0 to 1
    memory_MB: float | None = None  # resident, of this program
    memory_free_MB: float | None = None  # what programs could still take
    disk_free_MB: float | None = None
    throttled: list[str] | None = None  # "undervoltage" now, "undervoltage-was" before


class Board:
    """Reads the board under `root`; `disk` is a folder of the file system that may fill up.

    MB are 10^6 bytes. A value that is absent, unreadable or cannot be is None. For one thread.
    """

    def __init__(self, root: Path = Path("/"), disk: Path | None = None) -> None:
        self._thermal, self._sensors = root / "sys/class/thermal", root / "sys/class/hwmon"
        self._stat, self._meminfo = str(root / "proc/stat"), str(root / "proc/meminfo")
        self._statm = str(root / "proc/self/statm")
        self._firmware = str(root / "sys/devices/platform/soc/soc:firmware/get_throttled")
        self._disk = disk
        self._zones: list[Path] = []
        self._voltage: Path | None = None
        self._cpu_before: tuple[int, int] | None = None

    def read(self) -> BoardState:
        """The state now; the first reading has no `cpu`."""
        return BoardState(
            temperature_C=self._temperature_c(),
            cpu=self._cpu(),
            memory_MB=self._memory_mb(),
            memory_free_MB=self._memory_free_mb(),
            disk_free_MB=self._disk_free_mb(),
            throttled=self._throttled(),
        )

    def _temperature_c(self) -> float | None:
        if not self._zones:
            self._zones = [
                zone / "temp"
                for zone in _children(self._thermal, "thermal_zone")
                if (small_files.text(zone / "type") or "").lower().startswith(_CPU_ZONES)
            ]
        values = [small_files.number(zone) for zone in self._zones]
        found = [value / 1000 for value in values if value is not None]
        found = [value for value in found if _COLDEST_C <= value <= _HOTTEST_C]
        if not found:
            self._zones = []  # the driver may have been loaded again
        return max(found, default=None)

    def _cpu(self) -> float | None:
        match = _CPU.match(small_files.text(self._stat) or "")
        times = [int(field) for field in match[1].split()] if match else []
        if len(times) <= _IOWAIT:
            self._cpu_before = None
            return None
        total = sum(times[: _STEAL + 1])
        idle = times[_IDLE] + times[_IOWAIT]
        before, self._cpu_before = self._cpu_before, (total, idle)
        if before is None or total <= before[0]:
            return None
        # The kernel's count of waiting may go back a little.
        return min(max(1 - (idle - before[1]) / (total - before[0]), 0.0), 1.0)

    def _memory_mb(self) -> float | None:
        # statm, not smaps_rollup: that one walks the page tables, which takes milliseconds.
        match = _STATM.match(small_files.text(self._statm) or "")
        pages = int(match[1]) if match else 0
        return pages * os.sysconf("SC_PAGE_SIZE") / _MB if pages else None

    def _memory_free_mb(self) -> float | None:
        match = _AVAILABLE.search(small_files.text(self._meminfo) or "")
        return int(match[1]) * 1024 / _MB if match else None

    def _disk_free_mb(self) -> float | None:
        if self._disk is None:
            return None
        try:
            state = os.statvfs(self._disk)
        except (OSError, ValueError):
            return None
        return state.f_bavail * state.f_frsize / _MB

    def _throttled(self) -> list[str] | None:
        found = (small_files.text(self._firmware) or "").strip()
        if not _HEX.fullmatch(found):
            return self._undervoltage()
        bits = int(found, 16)
        now = [name for bit, name in _BITS.items() if bits >> bit & 1]
        return now + [name + WAS for bit, name in _BITS.items() if bits >> bit + _WAS_SHIFT & 1]

    def _undervoltage(self) -> list[str] | None:
        """What a kernel without the Pi's patches can tell: its alarm of the last two seconds."""
        if self._voltage is None:
            for sensor in _children(self._sensors, "hwmon"):
                if (small_files.text(sensor / "name") or "").strip() == "rpi_volt":
                    self._voltage = sensor / "in0_lcrit_alarm"
        alarm = None if self._voltage is None else small_files.number(self._voltage)
        if alarm not in (0, 1):
            self._voltage = None
            return None
        return [UNDERVOLTAGE] if alarm else []


def _children(folder: Path, prefix: str) -> list[Path]:
    try:
        return sorted(path for path in folder.iterdir() if path.name.startswith(prefix))
    except OSError:
        return []
