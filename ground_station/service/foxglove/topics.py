"""A topic of the server: nothing is built for it that nobody listens to."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from typing import Any

from foxglove import Channel, Context

Make = Callable[[], Any]
Kept = Callable[[], Iterable[tuple[Make, int]]]


class Topic:
    """A channel, and what a new subscriber is told at once: pairs of a maker and a log time.

    To be used from one thread. The server never waits for a client: one that is slow loses the
    oldest messages of its own queue.
    """

    def __init__(self, channel: Any, kept: Kept | None = None) -> None:
        self._channel, self._kept = channel, kept

    @property
    def id(self) -> int:
        """The channel's, as subscriptions name it."""
        number: int = self._channel.id()
        return number

    @property
    def wanted(self) -> bool:
        """Whether anyone listens."""
        return bool(self._channel.has_sinks())

    def say(self, make: Make, log_ns: int, client: int | None = None) -> None:
        """Sends what `make` gives, a message or a JSON object, to all or to one client."""
        if not self.wanted:
            return
        message = make()
        if isinstance(message, dict):
            message = json.dumps(message, separators=(",", ":"), allow_nan=False).encode()
        self._channel.log(message, log_time=log_ns, sink_id=client)

    def close(self) -> None:
        """Nobody can subscribe to it any more."""
        self._channel.close()

    def greet(self, client: int) -> None:
        """Tells a new subscriber what was said before it came and still holds."""
        for make, log_ns in self._kept() if self._kept else ():
            self.say(make, log_ns, client)


def json_topic(
    name: str, schema: dict[str, Any], context: Context, kept: Kept | None = None
) -> Topic:
    """A topic of JSON objects."""
    return Topic(Channel(name, schema=schema, context=context), kept)
