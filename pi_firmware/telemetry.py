"""The payload's telemetry: publishes messages, takes what the ground says, and is asked things."""

from __future__ import annotations

import contextlib
import re
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from pi_firmware.settings import TelemetrySettings
from pi_firmware.wire import credentials, keys, messages
from pi_firmware.wire.clock_offset import Clock, RoundTrip, ask, serve
from pi_firmware.wire.errors import TelemetryError
from pi_firmware.wire.refusal import refusal
from pi_firmware.wire.telemetry import Session, open_session

M = TypeVar("M", bound=messages.Message)
_REFUSALS_LIMIT_S = 5.0
_CLOSED_S = 12.0
"""Zenoh gives up closing a link that nobody answers on after 10 s."""
_KIND_OF = {message: kind for kind, message in messages.KINDS.items()}
_ENDPOINT = re.compile(r"^[a-z]+/(\[[^\]]+\]|[^/:]+):\d+")

Tap = Callable[[str, messages.Message], None]
Asked = Callable[[str, messages.Command, Callable[[messages.Answer], None]], None]


class Telemetry:
    """Publishes under one payload's keys; sends nothing when disabled. Safe from any thread.

    `tap` gets each message with its kind as well, sent or not: the recorder.
    """

    def __init__(
        self,
        payload_id: str,
        settings: TelemetrySettings,
        clock: Clock = time.time_ns,
        tap: Tap = lambda kind, message: None,
    ) -> None:
        self._tap = tap
        self._settings = settings
        self._session: Session | None = None
        self._looks: Session | None = None
        self._found: set[str] = set()
        """Endpoints of the ground station that was asked for last, while it was linked."""
        self._publishers: dict[str, Any] = {}
        self._held: credentials.Credentials | None = None
        self._now = clock
        self._payload_id = payload_id
        self._declare: list[Callable[[Any], Any]] = []
        """What declares each of the things below in a session, a new one, too."""
        self._declared: list[Any] = []
        self._closing: list[threading.Thread] = []
        if not settings.enabled:
            return
        if settings.certificates:
            self._held = held = credentials.load(settings.certificates)
            if held.name != f"{credentials.PAYLOAD}.{payload_id}":
                raise TelemetryError(
                    f"certificates in {settings.certificates} are {held.name}'s,"
                    f" not payload.{payload_id}'s"
                )
        self._declare = [
            lambda session: serve(session, keys.key(payload_id, keys.CLOCK), clock),
            lambda session: session.liveliness().declare_token(keys.key(payload_id, keys.ALIVE)),
        ]
        self._open(settings.connect, settings.discover)
        self._looks = self._session

    def _open(self, connect: Sequence[str], scout: str = "") -> None:
        import zenoh

        self._session = open_session(
            listen=self._settings.listen,
            connect=connect,
            certificates=self._settings.certificates,
            scout=scout,
        )
        session = self._session.zenoh
        # Events are rare and must arrive; of the others a newer one follows at once.
        control = zenoh.CongestionControl
        self._publishers = {
            kind: session.declare_publisher(
                keys.key(self._payload_id, kind),
                congestion_control=control.BLOCK if kind == keys.EVENT else control.DROP,
            )
            for kind in messages.KINDS
        }
        self._declared = [declare(session) for declare in self._declare]

    def renew(self) -> bool:
        """A new session with the ground station that was there last; False where it cannot be.

        For one that is `outdated`, which this one stays: where Zenoh looks from it reads once in a
        process. All that is listened to stays so. The old session is closed beside, as it waits for
        links on which nobody answers, and holds the ports that it may listen on.
        """
        old = self._session
        if old is None or not self._found or self._settings.listen:
            return False
        try:
            self._open([*self._settings.connect, *sorted(self._found)])
        except TelemetryError:
            return False
        thread = threading.Thread(target=old.close, name="telemetry", daemon=True)
        self._closing = [one for one in self._closing if one.is_alive()] + [thread]
        thread.start()
        return True

    @property
    def listening(self) -> tuple[str, ...]:
        return self._session.listening if self._session else ()

    @property
    def outdated(self) -> bool:
        """Whether nobody is found any more, but by another process; see `Session.outdated`."""
        return self._looks is not None and self._looks.outdated

    def publish(self, message: messages.Message) -> None:
        """Publishes a message of one of the kinds that a payload tells."""
        kind = _KIND_OF[type(message)]
        self._tap(kind, message)
        if self._session is not None:
            import zenoh

            with contextlib.suppress(zenoh.ZError):  # of a session that another replaces now
                self._publishers[kind].put(messages.encode(message))

    def on(self, kind: str, of: type[M], take: Callable[[M], None]) -> None:
        """Calls `take` with each message of a kind that a ground station publishes to this payload.

        On a thread of the session; what is not as agreed is dropped.
        """

        def received(sample: Any) -> None:
            with contextlib.suppress(TelemetryError):
                take(messages.decode(of, sample.payload.to_bytes()))

        key = keys.key(self._payload_id, kind)
        self._add(lambda session: session.declare_subscriber(key, received))

    def _add(self, declare: Callable[[Any], Any]) -> None:
        if self._session is not None:
            self._declare.append(declare)
            self._declared.append(declare(self._session.zenoh))

    def on_command(self, ask: Asked) -> None:
        """Hands each command to `ask` with its name and what takes the answer.

        A question to several commands at once is one to a command that does not exist.
        """

        def asked(query: Any) -> None:
            key = str(query.key_expr)

            def answer(message: messages.Answer) -> None:
                with contextlib.suppress(Exception):  # whoever asked may be gone
                    query.reply(key, messages.encode(message))
                    query.drop()

            payload = query.payload.to_bytes() if query.payload is not None else b""
            try:
                command = messages.decode(messages.Command, payload)
            except TelemetryError as error:
                answer(messages.Answer(time_ns=time.time_ns(), done=False, reason=str(error)))
                return
            ask(key.rpartition("/")[2], command, answer)

        key = keys.command(self._payload_id, "*")
        self._add(lambda session: session.declare_queryable(key, asked))

    def ground_address(self, ground: str) -> str | None:
        """The numeric address of a ground station that is connected; None when it is not.

        With certificates it is the one whose certificate says its name; without, on loopback, the
        only one there is.
        """
        if self._session is None:
            return None
        found = {}
        for link in self._session.zenoh.info.links():
            identity = str(link.auth_identifier or "")
            if self._held is None or identity == f"{credentials.GROUND}.{ground}":
                match = _ENDPOINT.match(str(link.dst))
                if match:
                    found[match[0]] = match[1].strip("[]")
        self._found = set(found) or self._found
        hosts = set(found.values())
        return hosts.pop() if len(hosts) == 1 else None

    def ask_time(self) -> RoundTrip | None:
        """One round trip to the ground station's clock; None without an answer."""
        if self._session is None:
            return None
        import zenoh

        with contextlib.suppress(zenoh.ZError):  # of a session that another replaces now
            return ask(self._session.zenoh, keys.key(self._payload_id, keys.TIME), self._now)
        return None

    def refusals(self) -> list[str]:
        """Why the ground stations that it connects to take no part, a line for each that tells.

        Looks only while it speaks to nobody, and takes some seconds.
        """
        if self._session is None or self._held is None:
            return []
        if self._session.linked() & set(self._held.peers):
            return []
        until_s = time.monotonic() + _REFUSALS_LIMIT_S
        found = []
        for endpoint in self._settings.connect:
            if time.monotonic() < until_s and (why := refusal(endpoint, self._held)):
                found.append(why)
        return found

    def close(self) -> None:
        """Withdraws the liveliness token and closes the session."""
        if self._session is not None:
            for declared in self._declared:
                declared.undeclare()
            self._session.close()
            self._session = None
        for thread in self._closing:
            thread.join(_CLOSED_S)
