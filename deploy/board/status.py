"""STATUS.txt on the boot partition: how the card is, for whoever puts it into a laptop."""

from __future__ import annotations

from dataclasses import dataclass

from deploy.board import faults
from deploy.board.card import Card, writable
from deploy.board.disk import Disk, read_bounded
from deploy.board.faults import Fault
from deploy.board.journal import one_line
from deploy.errors import DeployError

FILE = "STATUS.txt"
_MOST_BYTES = 64 * 1024


@dataclass(frozen=True)
class Status:
    """All that the file tells. There is no time in it: a board without a clock has none, and a
    text that stays the same is not written again."""

    board: str = ""
    image: str = ""
    release: str = ""
    payload_id: str = ""
    network: str = ""
    fault: Fault | None = None
    reason: str = ""
    warning: str = ""


def render(status: Status) -> bytes:
    """The file: UTF-8, with the line ends of Windows, whose editor knows no others."""
    fault = status.fault
    blinks = f" ({fault.blinks} blinks)" if fault else ""
    lines = [
        "Blimp payload: how this card was when it last wrote this file.",
        "",
        f"State:    {'FAULT: ' + fault.what + blinks if fault else 'streaming'}",
    ]
    if fault and status.reason:
        lines.append(f"Reason:   {one_line(status.reason)}")
    if fault:
        lines.append(f"To fix:  {fault.fix}")
    if status.warning:
        lines.append(f"Warning:  {one_line(status.warning)}")
    lines += [
        "",
        f"Payload:  {one_line(status.payload_id) or 'none yet'}",
        f"Network:  {one_line(status.network) or 'none'}",
        f"Firmware: {one_line(status.release) or 'unknown'}",
        f"Image:    {one_line(status.image) or 'unknown'}, for the board {one_line(status.board)}",
        "",
        "The green light: steady is starting, a heartbeat is streaming; so many short blinks and a",
        "pause mean:",
        *(f"  {fault.blinks}  {fault.what}" for fault in faults.ALL),
        "",
        "To change name, network or keys: edit blimp.toml in this folder, start the payload again.",
    ]
    return "".join(f"{line}\r\n" for line in lines).encode()


def write(card: Card, disk: Disk, text: bytes) -> bool:
    """Writes the file unless it says the same already; whether the card was written to.

    Raises `DeployError` and `OSError` when it cannot be.
    """
    path = card.boot / FILE
    if not card.boot.is_dir():
        raise DeployError(f"{card.boot}: not there")
    if read_bounded(path, _MOST_BYTES) == text:
        return False
    with writable(card):
        disk.write(path, text)
    return True
