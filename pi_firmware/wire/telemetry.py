"""Zenoh sessions as both sides open them: explicit endpoints, scouting only where it is asked."""

from __future__ import annotations

import atexit
import contextlib
import ipaddress
import json
import re
import socket
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from pi_firmware.wire import credentials, scouting
from pi_firmware.wire.errors import TelemetryError

PORT = 7447
MESSAGE_BYTES = 64 * 1024
"""A longer message is dropped as it comes; the largest of ours has a few thousand."""
LOCAL_ENDPOINT = f"tcp/127.0.0.1:{PORT}"
_ENDPOINT = re.compile(r"(tcp|tls)/(\[[0-9a-fA-F:]+\]|[^\[\]:/#?]+):(\d{1,5})")
_ATTEMPTS = 5
_CALLBACK_THREAD = "pyo3-closure"
_CALLBACKS_END_S = 2.0


@dataclass(frozen=True)
class Session:
    """An open Zenoh session and the endpoints it listens on, ephemeral ports filled in.

    `interface` is the one that it is to look or answer on, and `scouting` the address that it does
    so from; both are empty where it does not.
    """

    zenoh: Any
    listening: tuple[str, ...]
    interface: str = ""
    scouting: str = ""

    @property
    def outdated(self) -> bool:
        """Whether the interface has another address now than the one that it looks from.

        Zenoh looks from the addresses that were there when the session was opened: only a new
        session finds anyone from this one.
        """
        address = scouting.interface_address(self.interface) if self.interface else None
        return address is not None and address != self.scouting

    def linked(self) -> set[str]:
        """The names in the certificates of all that are connected.

        A link is made with whoever the authority signed; who is not on the list says nothing over
        it, and Zenoh does not tell.
        """
        links = self.zenoh.info.links()
        return {str(link.auth_identifier) for link in links if link.auth_identifier}

    def close(self) -> None:
        """Sends what is queued and closes; a second call does nothing.

        It takes up to 10 s where the other side of a link has gone without a word.
        """
        import zenoh

        with contextlib.suppress(zenoh.ZError):  # whoever would answer has gone
            self.zenoh.close()


def check_endpoint(endpoint: str, *, certified: bool = False) -> tuple[str, int]:
    """Host and port of `tcp/HOST:PORT` or `tls/HOST:PORT`; raises `TelemetryError` with one line.

    With certificates (`certified`) every endpoint is `tls/`, anywhere. Without, only loopback is
    taken: beyond it nobody speaks without a certificate.
    """
    match, what = _ENDPOINT.fullmatch(endpoint), f"telemetry endpoint {endpoint!r:.80}:"
    if match is None or int(match[3]) > 65535:
        expected = "tls/HOST:PORT" if certified else "tcp/HOST:PORT"
        raise TelemetryError(f"{what} expected {expected}")
    scheme, host, port = match[1], match[2], int(match[3])
    if certified and scheme != "tls":
        raise TelemetryError(f"{what} with certificates only tls/HOST:PORT is allowed")
    if not certified and scheme == "tls":
        raise TelemetryError(f"{what} tls needs a folder of certificates (blimp keys)")
    if not certified and not is_loopback(host.strip("[]")):
        raise TelemetryError(f"{what} only loopback is allowed without certificates")
    return host, port


def is_loopback(host: str) -> bool:
    """Whether a numeric address, or the name `localhost`, is this machine's own."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def open_session(
    *,
    listen: Sequence[str] = (),
    connect: Sequence[str] = (),
    certificates: str | Path = "",
    scout: str = "",
    discoverable: str = "",
    client_timeout_s: float | None = None,
    rules: Mapping[str, Any] | None = None,
    more: Mapping[str, Any] = MappingProxyType({}),
) -> Session:
    """Opens a session that listens and connects at these endpoints, and nowhere else.

    With a folder of `certificates` all is mutual TLS and whatever its access rules do not name is
    refused; without, only loopback is spoken to.

    `scout` names an interface to look on for others, again and again at most 8 s apart, and to
    connect to whoever answers; `discoverable` one to answer on, with the endpoints of `listen`.
    Without certificates it can only be `lo`. An interface that has no address yet is waited for;
    if it gets none the session is opened all the same, and is `outdated` once there is one.

    With `client_timeout_s` it is a client: it has one link, to the first of `connect` that takes it
    within that time, and whoever that is hands on what it says to its own peers. Otherwise it is a
    peer, which speaks to those it is linked with and hands on nothing between them.

    `rules` stand in place of those between payloads and ground stations (`credentials.Rules`), and
    `more` of other settings of Zenoh's.

    A listening port 0 stands for any free one. A peer that is not there yet is tried again in the
    background. Raises `TelemetryError` with one line, for one when an endpoint is in use.
    """
    import zenoh

    atexit.unregister(_await_callbacks)
    atexit.register(_await_callbacks)
    held = credentials.load(certificates) if str(certificates) else None
    for endpoint in connect:
        check_endpoint(endpoint, certified=held is not None)
    interface = scouting.check(scout, discoverable, listen, certified=held is not None)
    address = scouting.await_address(interface) if interface else ""
    more = dict(more)
    if address:
        more |= scouting.settings(interface, look=bool(scout), answer=bool(discoverable))
    if client_timeout_s is not None:
        more |= {"mode": "client", "connect/timeout_ms": round(1000 * client_timeout_s)}
    for attempt in range(_ATTEMPTS):
        endpoints = [_with_port(endpoint, held is not None) for endpoint in listen]
        try:
            config = session_config(endpoints, connect, held, more, rules)
            return Session(zenoh.open(config), tuple(endpoints), interface, address)
        except zenoh.ZError as error:
            in_use = "in use" in str(error)
            # Another program may take the free port between choosing and opening it.
            if in_use and endpoints != list(listen) and attempt + 1 < _ATTEMPTS:
                continue
            reason = "the port is in use" if in_use else str(error).splitlines()[0][:160]
            if "Unable to connect" in reason:
                reason = "nobody is there, or takes this certificate; is blimp serve running there?"
            where = ", ".join([*endpoints, *connect]) or "no endpoint"
            raise TelemetryError(f"telemetry at {where}: {reason}") from None
    raise AssertionError("unreachable")


def callback_threads() -> list[threading.Thread]:
    """The threads on which Zenoh runs callbacks: one for each subscriber and queryable."""
    return [thread for thread in threading.enumerate() if _CALLBACK_THREAD in thread.name]


def _await_callbacks() -> None:
    """Lets the callbacks' threads end, which takes a moment after their session is closed.

    One that comes back from Rust when the interpreter is already going makes it abort: an orderly
    end would be signal 6, in about one of twenty.
    """
    until_s = time.monotonic() + _CALLBACKS_END_S
    for thread in callback_threads():
        thread.join(max(0.0, until_s - time.monotonic()))


def _with_port(endpoint: str, certified: bool) -> str:
    host, port = check_endpoint(endpoint, certified=certified)
    if port:
        return endpoint
    bare = host.strip("[]")
    family = socket.AF_INET6 if ":" in bare else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.bind((bare, 0))
        return f"{endpoint[:3]}/{host}:{probe.getsockname()[1]}"


def session_config(
    listen: Sequence[str],
    connect: Sequence[str],
    held: credentials.Credentials | None = None,
    more: Mapping[str, Any] = MappingProxyType({}),
    rules: Mapping[str, Any] | None = None,
) -> Any:
    """The `zenoh.Config` of a session that listens and connects at these endpoints only.

    It is a peer that neither looks for others nor can be found, unless `more` settings say so.
    """
    import zenoh

    config = zenoh.Config()
    settings: dict[str, Any] = {
        "mode": "peer",
        "listen/endpoints": list(listen),
        "connect/endpoints": list(connect),
        "connect/exit_on_failure": False,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        # On one host large payloads would silently go through /dev/shm, which may be small.
        "transport/shared_memory/enabled": False,
        "transport/link/rx/max_message_size": MESSAGE_BYTES,
    }
    settings |= more
    if held is not None:
        settings |= credentials.tls_settings(held, rules)
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    return config
