"""A Raspberry Pi 3 in QEMU: power on, its serial line, power cut, power on again.

It is not the Pi's boot ROM and firmware (the kernel is handed over from the card's own boot
partition), its encoder, its radio, its hardware watchdog, or its pace. QEMU 10's `raspi3b` and what
it is missing, as far as it shows here:
- its power controller answers no requests: the driver for it stays out, the one for watchdog and
  reset, which hangs on the same device, stays in, so that the board can reboot and power off;
- its watchdog resets the board in the moment it is armed: systemd gets none to arm;
- it has no clock: the board begins in 1970, as a real one does;
- a completed write to its SD card is durable. A power cut ends the machine between two instructions
  and loses what had not been sent to the card, but tears no sector and empties no cache of a card.
"""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import emulator_gauge as gauge
from emulator_card import Boot

from deploy.errors import DeployError

HOST = "10.0.2.2"
"""Where the board finds this computer."""
QEMU = Path(__file__).resolve().parents[3] / "out/emulator/qemu-system-aarch64"
_WORDS = "initcall_blacklist=bcm2835_power_driver_init systemd.watchdog_device=/dev/none panic=-1"
_CONSOLE = "ttyAMA0,115200"
# Named, QEMU puts no hub between, whose enumeration sometimes fails ("dwc2: Not connected").
_USB_PORT = 1
_POLL_S = 0.1
_TAIL_LINES = 25
_CUT_LIMIT_S = 30.0

T = TypeVar("T")


class Machine:
    """One board with its card; a context manager that takes the power away at the end.

    Args:
        card: the card's image, its size a power of two; written to.
        boot: what its boot partition holds.
        folder: where the logs go: `serial-N.log` and `qemu-N.log` for the N-th power-on.
        gauge_file: the gauge's registers (`emulator_gauge`); none: no gauge on the bus.
        forward: ports of this computer's loopback by the board's port they lead to, TCP.
        words: more for the kernel line.
        qemu: the program.
    """

    def __init__(
        self,
        card: Path,
        boot: Boot,
        folder: Path,
        *,
        gauge_file: Path | None = None,
        forward: Mapping[int, int] | None = None,
        words: str = "",
        qemu: Path = QEMU,
    ) -> None:
        self.card, self.boot, self.folder = card, boot, folder
        self.words = words
        self.power_ons = 0
        self.started_s = 0.0
        self._gauge, self._forward, self._qemu = gauge_file, dict(forward or {}), qemu
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Machine:
        return self

    def __exit__(self, *_: object) -> None:
        self.cut()

    def start(self) -> None:
        """Power on; returns at once."""
        if self.running:
            raise DeployError("the machine is on already")
        if not self._qemu.is_file():
            raise DeployError(f"{self._qemu}: not there; `sh tests/hil/image/tools.sh` makes it")
        self.folder.mkdir(parents=True, exist_ok=True)
        self.power_ons += 1
        self.log.unlink(missing_ok=True)
        with (self.folder / f"qemu-{self.power_ons}.log").open("wb") as log:
            self.started_s = time.monotonic()
            self._process = subprocess.Popen(
                self.command(), stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT
            )

    def command(self) -> list[str]:
        """QEMU's words for the next power-on."""
        net = "".join(
            f",hostfwd=tcp:127.0.0.1:{here}-:{there}" for there, here in self._forward.items()
        )
        line = [self.boot.command_line, _WORDS, self.words]
        line.append(f"console={_CONSOLE}")  # the last one is the one that init writes to
        words: list[str | Path] = [self._qemu, "-M", "raspi3b", "-display", "none", "-no-reboot"]
        words += ["-monitor", "none", "-serial", f"file:{self.log}"]
        words += ["-kernel", self.boot.kernel, "-dtb", self.boot.device_tree]
        if self.boot.initrd is not None:
            words += ["-initrd", self.boot.initrd]
        words += ["-append", " ".join(part for part in line if part)]
        words += ["-drive", f"file={self.card},if=sd,format=raw"]
        words += ["-netdev", f"user,id=net{net}", "-device", f"usb-net,netdev=net,port={_USB_PORT}"]
        if self._gauge is not None:
            words += ["-drive", f"file={self._gauge},if=none,format=raw,id=gauge"]
            words += ["-device", ",".join([
                "at24c-eeprom", "bus=i2c-bus.1", f"address={gauge.ADDRESS}",
                f"rom-size={gauge.SIZE}", "address-size=1", "drive=gauge",
            ])]  # fmt: skip
        return [str(word) for word in words]

    @property
    def log(self) -> Path:
        """What the board has said on its serial line since it was last powered on."""
        return self.folder / f"serial-{self.power_ons}.log"

    @property
    def running(self) -> bool:
        """Whether it has power; a board that rebooted or powered off has none."""
        return self._process is not None and self._process.poll() is None

    @property
    def age_s(self) -> float:
        """Time since power-on, s."""
        return time.monotonic() - self.started_s

    def cut(self) -> None:
        """Takes the power away between two instructions."""
        if self._process is not None:
            self._process.kill()
            self._process.wait(_CUT_LIMIT_S)
            self._process = None

    def wait(self, look: Callable[[], T | None], limit_s: float, what: str) -> T:
        """Waits until `look` gives something that is true, and returns it.

        Raises:
            DeployError: not within `limit_s`, or the board went off, with the serial log's end.
        """
        deadline = time.monotonic() + limit_s
        while True:
            on = self.running
            if found := look():
                return found
            if not on:
                raise DeployError(f"the board went off before {what}{self.tail()}")
            if time.monotonic() > deadline:
                raise DeployError(f"not within {limit_s:g} s: {what}{self.tail()}")
            time.sleep(_POLL_S)

    def tail(self, lines: int = _TAIL_LINES) -> str:
        """The end of what the board and QEMU said, for a message."""
        said: Sequence[str] = self._lines()[-lines:]
        emulator = self.folder / f"qemu-{self.power_ons}.log"
        if emulator.is_file():
            said = [*said, *emulator.read_text("utf-8", "replace").splitlines()[-3:]]
        return "".join(f"\n  | {line}" for line in said)

    def _lines(self) -> list[str]:
        if not self.log.is_file():
            return []
        return self.log.read_text("utf-8", "replace").splitlines()
