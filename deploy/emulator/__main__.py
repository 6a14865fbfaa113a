"""`python -m deploy.emulator IMAGE`: boots a card image and shows its serial line."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from deploy.emulator import card, gauge
from deploy.emulator.machine import QEMU, Machine
from deploy.errors import DeployError
from deploy.run import run

_ROOM = QEMU.parent
_TOOLS = Path(__file__).with_name("tools.sh")
_RESTARTS = "reboot: Restarting system"
_POLL_S = 0.2
_EXAMPLE = """example:
  sudo .venv/bin/python -m deploy.image --board qemu
  truncate -s 4G out/emulator/card.img
  .venv/bin/python -m deploy.flash --device out/emulator/card.img \\
      --image out/image/blimp-qemu.img --payload blimp-1 --no-wifi --ground 10.0.2.2
  .venv/bin/python -m deploy.emulator --card out/emulator/card.img --volts 3.7

The board finds this computer at 10.0.2.2. Ctrl-C takes its power away."""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m deploy.emulator",
        description="Boots a card in an emulated Raspberry Pi 3 with camera, gauge and network.",
        epilog=_EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("image", nargs="?", type=Path, metavar="IMAGE", help="a card image, which is copied")
    add("--card", type=Path, metavar="FILE", help="a card to write to, its size a power of two")
    add("--volts", type=float, default=3.9, help="what the gauge shows, V, 0 to 5.11 (3.9)")
    add("--percentage", type=float, default=0.7, help="state of charge, 0 to 1 (0.7)")
    add("--ssh-port", type=int, metavar="PORT", help="of 127.0.0.1, that leads to its sshd")
    add("--words", default="", help="more for the kernel's line")
    return parser


def main() -> int:
    """Status 0 when the board has powered off or was cut off, 2 on what a person can fix."""
    try:
        return _boot(_parser().parse_args())
    except DeployError as error:
        print(f"deploy.emulator: {error}", file=sys.stderr)
        return 2


def _boot(given: argparse.Namespace) -> int:
    if (given.image is None) == (given.card is None):
        raise DeployError("expected an IMAGE, or --card FILE, and not both")
    if given.ssh_port is not None and not 1 <= given.ssh_port <= 65535:
        raise DeployError(f"--ssh-port is {given.ssh_port}; allowed: 1 to 65535")
    registers = gauge.registers(given.volts, given.percentage)
    run(["sh", _TOOLS])
    place = given.card or _ROOM / "card.img"
    if given.image is not None:
        card.working_copy(given.image, place)
    gauge_file = _ROOM / "gauge.bin"
    gauge_file.write_bytes(registers)
    with Machine(
        place,
        card.boot_files(place, _ROOM / "boot"),
        _ROOM / "logs",
        gauge_file=gauge_file,
        forward={22: given.ssh_port} if given.ssh_port is not None else None,
        words=given.words,
    ) as machine:
        try:
            while True:
                machine.start()
                if _RESTARTS not in _show(machine):
                    return 0
        except KeyboardInterrupt:
            print("\ndeploy.emulator: power cut")
            return 0


def _show(machine: Machine) -> str:
    """Copies the serial line to standard output until the board goes off; gives the last lines."""
    shown = 0
    while True:
        on = machine.running
        text = machine.log.read_bytes() if machine.log.is_file() else b""
        sys.stdout.write(text[shown:].decode("utf-8", "replace"))
        sys.stdout.flush()
        shown = len(text)
        if not on:
            return text[-4096:].decode("utf-8", "replace")
        time.sleep(_POLL_S)


if __name__ == "__main__":
    sys.exit(main())
