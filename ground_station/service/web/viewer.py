"""One viewer's WebSocket: what waits for it goes out at its own pace, what it says is checked."""

from __future__ import annotations

import asyncio
import json
from collections import deque
from collections.abc import Callable
from typing import Any

from fastapi import WebSocket
from starlette.websockets import WebSocketDisconnect

from ground_station.service.web.access import Buckets

# Messages that each count (events, alarms) stand in a short queue; of what replaces itself (the
# state, a payload's estimate, the picture) only the newest is kept. So a viewer that is slow or has
# stopped costs the same memory as one that is quick, and hears less.

TEXTS = 64
SLOTS = 40


class Outbox:
    """One viewer's; for the event loop's thread only."""

    def __init__(self) -> None:
        self.pictures_lost = 0
        self._texts: deque[str] = deque(maxlen=TEXTS)
        self._newest: dict[str, str] = {}
        self._picture: bytes | None = None
        self._there = asyncio.Event()

    def queue(self, text: str) -> None:
        """Queues a message; the oldest goes when there are too many."""
        self._texts.append(text)
        self._there.set()

    def replace(self, slot: str, text: str) -> None:
        """Puts a message in place of the one that waits in its slot."""
        if slot in self._newest or len(self._newest) < SLOTS:
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


TAKES_NOTHING_S = 10.0
MESSAGE_BYTES = 2048
_MESSAGES_HZ, _MESSAGES_BURST = 100.0, 200
_LARGEST = 1e15
_CLOSE_S = 1.0

ENDS, GONE, NOT_OBEYED, FAILED, TRY_LATER, SESSION_ENDED = 1001, 1006, 1008, 1011, 1013, 4401
"""Close codes; those below 4000 are RFC 6455's, section 7.4.1."""

Heard = Callable[[dict[str, Any]], None]


class Broken(Exception):
    """A viewer's message that is none."""


class Viewer:
    """One live connection; `sent` is called for each picture that went out."""

    def __init__(self, payload_id: str | None, sent: Callable[[], object] = lambda: None) -> None:
        self.payload_id, self._sent = payload_id, sent
        self.video = True
        self.outbox = Outbox()
        self.due_s: dict[str, float] = {}
        self.messages = Buckets(_MESSAGES_HZ, _MESSAGES_BURST)
        self.ended: asyncio.Future[tuple[int, str]] = asyncio.get_running_loop().create_future()

    def end(self, code: int, reason: str) -> None:
        """Closes the connection soon."""
        if not self.ended.done():
            self.ended.set_result((code, reason))

    async def serve(
        self, socket: WebSocket, heard: Heard, authorized: Callable[[], bool]
    ) -> tuple[int, str]:
        """Sends and hears until one side ends it: the close's code and reason, for `close`.

        `heard` gets each message, an object with a type, and raises `Broken` for what is none.
        """
        tasks = [
            asyncio.create_task(self._send(socket)),
            asyncio.create_task(self._receive(socket, heard)),
            asyncio.create_task(self._watch(authorized)),
        ]
        for task in tasks:
            task.add_done_callback(lambda _: self.end(GONE, ""))
        try:
            return await self.ended
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.wait(tasks)

    async def _send(self, socket: WebSocket) -> None:
        try:
            while True:
                message = await self.outbox.take()
                async with asyncio.timeout(TAKES_NOTHING_S):
                    if isinstance(message, str):
                        await socket.send_text(message)
                    else:
                        await socket.send_bytes(message)
                        self._sent()
        except TimeoutError:
            self.end(FAILED, f"took nothing for {TAKES_NOTHING_S:.0f} s")
        except (WebSocketDisconnect, RuntimeError, OSError):
            self.end(GONE, "")

    async def _receive(self, socket: WebSocket, heard: Heard) -> None:
        try:
            while True:
                text = await socket.receive_text()
                if self.messages.take("") > 0:
                    raise Broken("too many messages")
                heard(parse(text))
        except (Broken, KeyError) as error:  # a binary message has no text
            self.end(NOT_OBEYED, str(error) if isinstance(error, Broken) else "not text")
        except (WebSocketDisconnect, RuntimeError):
            self.end(GONE, "")

    async def _watch(self, authorized: Callable[[], bool]) -> None:
        while authorized():
            await asyncio.sleep(1.0)
        self.end(SESSION_ENDED, "the session has ended")


def parse(message: str) -> dict[str, Any]:
    """A viewer's message; raises `Broken` with what is wrong."""
    if len(message) > MESSAGE_BYTES:
        raise Broken(f"a message has at most {MESSAGE_BYTES} characters")
    try:
        found = json.loads(message)
    except (ValueError, RecursionError):
        raise Broken("not JSON") from None
    if not isinstance(found, dict) or not isinstance(found.get("type"), str):
        raise Broken("a message is an object with a type")
    return found


def finite(value: Any, what: str) -> float:
    """A number of a message; raises `Broken`."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not -_LARGEST <= value <= _LARGEST:
        raise Broken(f"{what} is no number")
    return float(value)


def said(kind: str, **content: Any) -> str:
    """A message to a viewer."""
    return json.dumps({"type": kind, **content}, separators=(",", ":"), allow_nan=False)


def may_stay(socket: WebSocket, holds: Callable[[str], bool]) -> Callable[[], bool]:
    """Whether a viewer is still allowed; `holds` tells whether a session's cookie is still good."""
    state = socket.scope.get("state", {})
    by, session = state.get("by"), str(state.get("session"))
    return lambda: by != "cookie" or holds(session)


async def close(socket: WebSocket, code: int, reason: str) -> None:
    """Closes as agreed, or the hard way where the other side takes nothing."""
    hard = code in (GONE, FAILED)
    try:
        async with asyncio.timeout(_CLOSE_S):
            if code != GONE:
                await socket.close(code, reason)
        if code == NOT_OBEYED and (abort := socket.scope.get("abort")):
            # It may go on sending; a moment for it to read why.
            asyncio.get_running_loop().call_later(_CLOSE_S, abort)
    except TimeoutError:
        hard = True
    except (RuntimeError, OSError):
        pass
    finally:
        # An orderly end would wait until everything was taken.
        if hard and (abort := socket.scope.get("abort")):
            abort()
