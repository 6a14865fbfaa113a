"""Datagrams at a port as fast as a radio brings them, from a process of its own.

    python tests/faults/scenarios/flood.py PORT KIND SSRC

Prints how many it has sent, a line a second, until it is killed.
"""

from __future__ import annotations

import os
import random
import socket
import struct
import sys
import time

KINDS = ("garbage", "streams", "forged")
RATE_HZ = 20_000
"""Of 1,200 bytes: 190 Mbit/s, more than a Pi's radio carries."""
_SIZE, _BURST = 1200, 200


def main(port: int, kind: str, ssrc: int) -> None:
    """Garbage, the first packets of ever new streams, or packets of a known one that are forged."""
    out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    out.connect(("127.0.0.1", port))
    rest, sent, told_s = os.urandom(_SIZE - 12), 0, time.monotonic()
    due_s = told_s
    while True:
        for _ in range(_BURST):
            stream = ssrc if kind == "forged" else random.randrange(1 << 32)
            head = struct.pack(">BBHII", 0x80, 96, sent & 0xFFFF, sent & 0xFFFFFFFF, stream)
            try:
                out.send(os.urandom(12) + rest if kind == "garbage" else head + rest)
            except ConnectionError:  # nobody listens at this moment
                continue
            sent += 1
        due_s += _BURST / RATE_HZ
        now_s = time.monotonic()
        if now_s > told_s + 1.0:
            told_s = now_s
            print(sent, flush=True)
        time.sleep(max(0.0, due_s - now_s))
        due_s = max(due_s, now_s - 0.1)


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2], int(sys.argv[3]))
