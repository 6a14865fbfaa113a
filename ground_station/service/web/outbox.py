"""What waits for one viewer: little, and never more than a little.

Messages that each count (events, alarms) stand in a short queue; of what replaces itself (the
state, a payload's estimate, the picture) only the newest is kept. So a viewer that is slow or has
stopped costs the same memory as one that is quick, and hears less.
"""

from __future__ import annotations

import asyncio
from collections import deque

TEXTS = 64
SLOTS = 40


class Outbox:
    """One viewer's; for the event loop's thread only. `lost` counts what it was not told."""

    def __init__(self) -> None:
        self.lost = 0
        self.pictures_lost = 0
        self._texts: deque[str] = deque()
        self._newest: dict[str, str] = {}
        self._picture: bytes | None = None
        self._there = asyncio.Event()

    def tell(self, text: str) -> None:
        """Queues a message; the oldest goes when there are too many."""
        if len(self._texts) >= TEXTS:
            self._texts.popleft()
            self.lost += 1
        self._texts.append(text)
        self._there.set()

    def replace(self, slot: str, text: str) -> None:
        """Puts a message in place of the one that waits in its slot."""
        if slot not in self._newest and len(self._newest) >= SLOTS:
            self.lost += 1
            return
        self.lost += slot in self._newest
        self._newest[slot] = text
        self._there.set()

    def show(self, picture: bytes) -> None:
        """Puts a picture in place of the one that waits."""
        self.pictures_lost += self._picture is not None
        self._picture = picture
        self._there.set()

    def forget_picture(self) -> None:
        """Takes back the picture that waits."""
        self._picture = None

    async def take(self) -> str | bytes:
        """The next to send: messages first, then what is newest, the picture last."""
        while True:
            if self._texts:
                return self._texts.popleft()
            if self._newest:
                return self._newest.pop(next(iter(self._newest)))
            if self._picture is not None:
                picture, self._picture = self._picture, None
                return picture
            self._there.clear()
            await self._there.wait()
