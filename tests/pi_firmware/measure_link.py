"""What a frame of the payload's link costs: what README says of it, measured anew.

    python tests/pi_firmware/measure_link.py [--only srtp,corrections] [--time]

Valgrind's callgrind counts the instructions of a program that sends 60 frames and of one that sends
180, of 4,200 bytes at 30 Hz, and their difference is told: of Python, GStreamer and libsrtp, of
this machine's kind of processor. Takes a minute or two for each kind of link. `--time` tells
processor time and memory in its place, on a board that has no valgrind: `whole_card.py` runs it on
the emulated one.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import resource
import shutil
import socket
import subprocess
import sys
import threading
import time
from dataclasses import dataclass

from pi_firmware.link import Link
from pi_firmware.settings import LinkSettings
from pi_firmware.wire import rtcp, video

UNIT = b"\0\0\0\1\x65" + b"\x55" * 4195
FEW, MANY, RATE_HZ, SSRC = 60, 180, 30, 77
_LIMIT_S = 600.0


@dataclass(frozen=True)
class Kind:
    """A kind of link, and which other one it is told beside; `asks`: for one packet of so many."""

    title: str
    beside: str = "bare"
    settings: tuple[tuple[str, float], ...] = ()
    srtp: bool = False
    asks: int = 0


BARE = (("history_s", 0.0), ("correction", 0.0))
KINDS = {
    "bare": Kind("packets and UDP alone", "", BARE),
    "history": Kind("the history, besides", settings=(("correction", 0.0),)),
    "srtp": Kind("SRTP, besides", settings=BARE, srtp=True),
    "corrections": Kind(
        "corrections at 5 % lost, besides", settings=(("history_s", 0.0), ("assumed_loss", 0.05))
    ),
    "again": Kind(
        "one packet of eight asked for and sent again, besides", "history",
        (("correction", 0.0),), asks=8,
    ),
}  # fmt: skip


def send(name: str, port: int, frames: int) -> None:
    """What is counted: one program that sends so many frames."""
    kind = KINDS[name]
    settings = LinkSettings(port=port, **dict(kind.settings))  # type: ignore[arg-type]
    link = Link(settings, SSRC, bytes(range(30)) if kind.srtp else None)
    link.start()
    for number in range(frames):
        while not link.send(UNIT, number * 10**9 // RATE_HZ, idr=True):
            time.sleep(1 / RATE_HZ)
        time.sleep(1 / RATE_HZ)
    link.flush()
    link.stop()


class Receiver(threading.Thread):
    """Takes the packets, counts them by what they are, and asks for one of every `asks` again."""

    def __init__(self, asks: int) -> None:
        super().__init__(daemon=True)
        self.counts: dict[int, int] = {}
        self._asks = asks
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))

    def run(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                datagram, whence = self.socket.recvfrom(2000)
                if not datagram:
                    return
                kind, sequence = datagram[1] & 0x7F, int.from_bytes(datagram[2:4], "big")
                self.counts[kind] = self.counts.get(kind, 0) + 1
                if self._asks and kind == video.PAYLOAD_TYPE and sequence % self._asks == 0:
                    self.socket.sendto(rtcp.nack(1, SSRC, [sequence]), whence)


class Sender:
    """Programs that send, and what one frame more of each kind costs."""

    def __init__(self, *, time_it: bool) -> None:
        self._time_it = time_it
        self.memory_mb: dict[str, float] = {}
        """The most that the longer program held, by the kind of link."""

    def frame(self, name: str) -> float:
        """Instructions or processor seconds of one frame more; tells what was sent."""
        (few, _), (many, counts) = self._run(name, FEW), self._run(name, MANY)
        print(f"{name}: packets of {MANY} frames by payload type: {counts}", file=sys.stderr)
        return (many - few) / (MANY - FEW)

    def _run(self, name: str, frames: int) -> tuple[float, dict[int, int]]:
        """Of one program, and how many packets it sent by payload type."""
        receiver = Receiver(KINDS[name].asks)
        receiver.start()
        port = receiver.socket.getsockname()[1]
        count = ["valgrind", "--tool=callgrind", "--callgrind-out-file=/dev/null"]
        done = subprocess.run(
            [*([] if self._time_it else count), sys.executable, __file__,
             "--send", f"{name},{port},{frames}"],
            capture_output=True, text=True, timeout=_LIMIT_S, check=False,
            env={**os.environ, "PYTHONHASHSEED": "0"},
        )  # fmt: skip
        receiver.socket.sendto(b"", ("127.0.0.1", port))
        receiver.join()
        receiver.socket.close()
        found = re.search(r"Collected : (\d+)", done.stderr)
        if done.returncode or not (found or self._time_it):
            raise SystemExit(f"{name}: status {done.returncode}: {done.stderr[-800:]}")
        if found:
            return int(found[1]), receiver.counts
        seconds, self.memory_mb[name] = map(float, done.stdout.split())
        return seconds, receiver.counts


def main() -> int:
    """Tells a line for each kind of link that is asked for."""
    parser = argparse.ArgumentParser(description="What a frame of the payload's link costs.")
    parser.add_argument("--only", default=",".join(KINDS), help=f"of {', '.join(KINDS)}")
    parser.add_argument("--time", action="store_true", help="processor time, not instructions")
    parser.add_argument("--json", action="store_true", help="the figures of each kind, as JSON")
    parser.add_argument("--send", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.send:
        name, port, frames = options.send.split(",")
        send(name, int(port), int(frames))
        used = resource.getrusage(resource.RUSAGE_SELF)
        print(used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)
        return 0
    names = options.only.split(",")
    if unknown := set(names) - KINDS.keys():
        parser.error(f"--only {', '.join(sorted(unknown))}: not one of {', '.join(KINDS)}")
    if not options.time and shutil.which("valgrind") is None:
        parser.error("valgrind is not installed: --time tells processor time in its place")
    sender = Sender(time_it=options.time)
    measured: dict[str, float] = {}
    for name in names:
        for one in filter(None, (name, KINDS[name].beside)):
            if one not in measured:
                measured[one] = sender.frame(one)
    if options.json:
        print(json.dumps({"frame": measured, "memory_MB": sender.memory_mb}))
        return 0
    for name in names:
        more = measured[name] - measured.get(KINDS[name].beside, 0.0)
        told = (
            f"{1e3 * more:.2f} ms a frame, {100 * RATE_HZ * more:.1f} % of a core; "
            f"{sender.memory_mb[name]:.1f} MB in all"
            if options.time
            else f"{more:,.0f} a frame, {RATE_HZ * more / 1e6:.1f} M a second"
        )
        print(f"{KINDS[name].title}: {told}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
