"""What the SDK logs, seldom: anyone who can reach the port can make it write a line at a time."""

from __future__ import annotations

import logging

from ground_station.service.localizing.rate_limited_log import RateLimitedLog

_LENGTH = 200


class RateLimitedHandler(logging.Handler):
    """Passes on one record of each logger a minute, with how many there were; warnings and up."""

    def __init__(self, say: RateLimitedLog) -> None:
        super().__init__(logging.WARNING)
        self._say = say

    def emit(self, record: logging.LogRecord) -> None:
        """Takes a record, under the handler's lock."""
        try:
            self._say(record.name, record.getMessage()[:_LENGTH])
        except Exception:
            self.handleError(record)


def install(say: RateLimitedLog) -> None:
    """Puts it in place of what Python would print."""
    logger = logging.getLogger("foxglove")
    logger.addHandler(RateLimitedHandler(say))
    logger.propagate = False
