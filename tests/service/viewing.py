"""A viewer at the live channel, as tests have it."""

from __future__ import annotations

import asyncio
import json

import websockets


def connect(port, path="/api/live", **arguments):
    return websockets.connect(
        f"ws://127.0.0.1:{port}{path}", compression=None, max_size=1 << 24, **arguments
    )


async def next_of(viewer, *kinds, limit_s=20.0):
    """The next message of a kind; a picture's kind is video."""
    async with asyncio.timeout(limit_s):
        while True:
            message = await viewer.recv()
            if isinstance(message, bytes):
                length = int.from_bytes(message[:4], "big")
                found = {**json.loads(message[4 : 4 + length]), "jpeg": message[4 + length :]}
            else:
                found = json.loads(message)
            if found["type"] in kinds:
                return found
