"""The payload's telemetry: publishes messages and holds the liveliness token."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import Any

from pi_firmware.settings import TelemetrySettings
from pi_firmware.wire import credentials, keys, messages
from pi_firmware.wire.clock_offset import Clock, serve
from pi_firmware.wire.errors import TelemetryError
from pi_firmware.wire.telemetry import Session, open_session


class Telemetry:
    """Publishes under one payload's keys; does nothing when disabled. Safe from any thread."""

    def __init__(
        self, payload_id: str, settings: TelemetrySettings, clock: Clock = time.time_ns
    ) -> None:
        self._session: Session | None = None
        self._publishers: dict[str, Any] = {}
        self._alive: Any = None
        self._clock: Any = None
        self._payload_id = payload_id
        self._subscribers: list[Any] = []
        if not settings.enabled:
            return
        import zenoh

        if settings.certificates:
            held = credentials.load(settings.certificates)
            if held.name != f"{credentials.PAYLOAD}.{payload_id}":
                raise TelemetryError(
                    f"certificates in {settings.certificates} are {held.name}'s,"
                    f" not payload.{payload_id}'s"
                )
        self._session = open_session(
            listen=settings.listen, connect=settings.connect, certificates=settings.certificates
        )
        session = self._session.zenoh
        for kind in (keys.BATTERY, keys.GATE, keys.EVENT, keys.AUTOPILOT):
            # Events are rare and must arrive; of the others a newer one follows at once.
            control = zenoh.CongestionControl
            self._publishers[kind] = session.declare_publisher(
                keys.key(payload_id, kind),
                congestion_control=control.BLOCK if kind == keys.EVENT else control.DROP,
            )
        self._clock = serve(session, keys.key(payload_id, keys.CLOCK), clock)
        self._alive = session.liveliness().declare_token(keys.key(payload_id, keys.ALIVE))

    @property
    def listening(self) -> tuple[str, ...]:
        """Endpoints that this session listens on."""
        return self._session.listening if self._session else ()

    def battery(self, message: messages.Battery) -> None:
        """Publishes a gauge's reading."""
        self._put(keys.BATTERY, message)

    def gate(self, message: messages.Gate) -> None:
        """Publishes the gate's decision on one frame."""
        self._put(keys.GATE, message)

    def event(self, message: messages.Event) -> None:
        """Publishes an event."""
        self._put(keys.EVENT, message)

    def autopilot(self, message: messages.Autopilot) -> None:
        """Publishes the autopilot's state."""
        self._put(keys.AUTOPILOT, message)

    def on_pose(self, take: Callable[[messages.Pose], None]) -> None:
        """Calls `take` with each pose of this payload that the ground station publishes.

        It is called on a thread of the session; what is no pose as agreed is dropped.
        """
        if self._session is None:
            return

        def received(sample: Any) -> None:
            with contextlib.suppress(TelemetryError):
                take(messages.decode(messages.Pose, sample.payload.to_bytes()))

        key = keys.key(self._payload_id, keys.POSE)
        self._subscribers.append(self._session.zenoh.declare_subscriber(key, received))

    def close(self) -> None:
        """Withdraws the liveliness token and closes the session."""
        if self._session is not None:
            self._alive.undeclare()
            self._clock.undeclare()
            self._session.close()
            self._session = None

    def _put(self, kind: str, message: messages.Message) -> None:
        if self._session is not None:
            self._publishers[kind].put(messages.encode(message))
