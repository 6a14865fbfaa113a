"""Gauges on I2C: the bus with its retries, and what a file in `chips` declares of a chip.

The drivers use the calls of `smbus2.SMBus`, so that a test's chips can stand behind them.
Re-opening fixes a stale file handle and a driver that was bound again. Clocking a slave free that
holds SDA low is the kernel's business (its bus recovery), not possible from here.
"""

from __future__ import annotations

import contextlib
import errno
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from pi_firmware.settings import BatterySettings
from pi_firmware.uri import Uri
from pi_firmware.wire.errors import SourceError
from pi_firmware.wire.messages import Battery

_ATTEMPTS = 4
_FIRST_PAUSE_S = 0.002  # doubles with each attempt: 2, 4, 8 ms, far beyond one transfer at 100 kHz


class GaugeError(SourceError):
    """A gauge that does not answer, or answers what cannot be; the next reading may be good."""


class Smbus(Protocol):
    """The part of `smbus2.SMBus` that the drivers use. A word's first byte is its low one."""

    def read_word_data(self, i2c_addr: int, register: int) -> int: ...

    def write_word_data(self, i2c_addr: int, register: int, value: int) -> None: ...

    def close(self) -> None: ...


@dataclass
class Counts:
    """What went wrong so far: failed transfers, refused readings, re-opened bus, reset chips."""

    errors: int = 0
    refused: int = 0
    reopened: int = 0
    resets: int = 0

    def refuse(self, reason: str) -> GaugeError:
        """Counts a reading that cannot be; the error to raise about it."""
        self.refused += 1
        return GaugeError(reason)


class WordBus:
    """16-bit registers, most significant byte first, of one chip.

    `open_bus` opens the bus and may raise `OSError`. A failed transfer (errno 121, remote I/O, is
    the usual one) is tried four times with growing pauses; then the bus is opened again and the
    transfer tried four times more; then it is a `GaugeError`. One that timed out (held low)
    is tried once each time. Not safe from several threads.
    """

    def __init__(
        self,
        open_bus: Callable[[], Smbus],
        address: int,
        name: str,
        counts: Counts,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._open_bus = open_bus
        self._address = address
        self._name = name
        self._counts = counts
        self._sleep = sleep
        self._bus: Smbus | None = None

    def read(self, register: int) -> int:
        """A register's value, 0 to 65535."""
        return swap(self._try(lambda bus: bus.read_word_data(self._address, register)))

    def write(self, register: int, value: int) -> None:
        """Sets a register, 0 to 65535."""

        def transfer(bus: Smbus) -> int:
            bus.write_word_data(self._address, register, swap(value))
            return 0

        self._try(transfer)

    def close(self) -> None:
        """Closes the bus; the next transfer opens it again."""
        bus, self._bus = self._bus, None
        if bus is not None:
            with contextlib.suppress(OSError):
                bus.close()

    def _try(self, transfer: Callable[[Smbus], int]) -> int:
        last: OSError | None = None
        for again in (False, True):
            if again:
                self.close()
                self._counts.reopened += 1
            for attempt in range(_ATTEMPTS):
                if attempt:
                    self._sleep(_FIRST_PAUSE_S * 2 ** (attempt - 1))
                try:
                    if self._bus is None:
                        self._bus = self._open_bus()
                    return transfer(self._bus)
                except OSError as error:
                    self._counts.errors += 1
                    last = error
                    if error.errno == errno.ETIMEDOUT:  # held low: each attempt would take 1 s
                        break
        self.close()
        reason = (last.strerror if last else "") or str(last)
        raise GaugeError(f"{self._name}: does not answer: {reason}")


def swap(word: int) -> int:
    """The two bytes of a word exchanged: SMBus sends the low byte first, the chips the high one."""
    return (word & 0xFF) << 8 | (word >> 8) & 0xFF


def signed(word: int) -> int:
    """A 16-bit register read as two's complement, -32768 to 32767."""
    return word - 0x10000 if word & 0x8000 else word


CHARGING = 1
"""Of a battery's `power_supply_status`."""
_DISCHARGING, _GOOD, _LIPO = 2, 1, 3


def reading(time_ns: int, voltage: float, *, charging: bool, **more: float | None) -> Battery:
    """What a gauge reads of a lithium-polymer cell; `more` are other fields of the message."""
    return Battery(
        time_ns=time_ns,
        voltage=voltage,
        power_supply_status=CHARGING if charging else _DISCHARGING,
        power_supply_health=_GOOD,
        power_supply_technology=_LIPO,
        **more,  # type: ignore[arg-type]  # those of numbers that may be unmeasured
    )


class Gauge(Protocol):
    """Anything that can say how much charge is left, or voltage and current to find it from."""

    counts: Counts

    def read(self, time_ns: int) -> Battery:
        """One reading, stamped with the payload's clock; raises `GaugeError` without one."""
        ...

    def close(self) -> None:
        """Releases the device; the next reading opens it again."""
        ...


@dataclass(frozen=True)
class Shunt:
    """The resistor and the largest current expected through it.

    `discharge_positive`: a discharging current flows from IN+ to IN-.
    """

    resistance_ohm: float = 0.1
    max_A: float = 3.0
    discharge_positive: bool = True


@dataclass(frozen=True)
class Chip:
    """The addresses that it can have, and what makes a gauge of a bus to one.

    `shunt` reads the options of `battery.uri` that say what current flows through which resistor;
    None for a chip that measures none. `open` raises `ValueError` for a shunt that it cannot use.
    """

    addresses: range
    open: Callable[[WordBus, Shunt, Counts, BatterySettings], Gauge]
    shunt: Callable[[Uri], Shunt] | None = None
