"""Zenoh sessions as both sides open them: explicit endpoints, no scouting, no shared memory."""

from __future__ import annotations

import ipaddress
import json
import re
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pi_firmware.wire import credentials
from pi_firmware.wire.errors import TelemetryError

PORT = 7447
LOCAL_ENDPOINT = f"tcp/127.0.0.1:{PORT}"
_ENDPOINT = re.compile(r"(tcp|tls)/(\[[0-9a-fA-F:]+\]|[^\[\]:/#?]+):(\d{1,5})")
_ATTEMPTS = 5


@dataclass(frozen=True)
class Session:
    """An open Zenoh session and the endpoints it listens on, ephemeral ports filled in."""

    zenoh: Any
    listening: tuple[str, ...]

    def close(self) -> None:
        """Sends what is queued and closes; a second call does nothing."""
        self.zenoh.close()


def check_endpoint(endpoint: str, *, certified: bool = False) -> tuple[str, int]:
    """Host and port of `tcp/HOST:PORT` or `tls/HOST:PORT`; raises `TelemetryError` with one line.

    With certificates (`certified`) every endpoint is `tls/`, anywhere. Without, only loopback is
    taken: beyond it nobody speaks without a certificate.
    """
    match = _ENDPOINT.fullmatch(endpoint)
    if match is None or int(match[3]) > 65535:
        expected = "tls/HOST:PORT" if certified else "tcp/HOST:PORT"
        raise TelemetryError(f"telemetry endpoint {endpoint!r}: expected {expected}")
    scheme, host = match[1], match[2].strip("[]")
    if certified:
        if scheme != "tls":
            raise TelemetryError(
                f"telemetry endpoint {endpoint!r}: with certificates only tls/HOST:PORT is allowed"
            )
        return match[2], int(match[3])
    if scheme == "tls":
        raise TelemetryError(
            f"telemetry endpoint {endpoint!r}: tls needs a folder of certificates (blimp keys)"
        )
    try:
        loopback = ipaddress.ip_address(host).is_loopback
    except ValueError:
        loopback = host == "localhost"
    if not loopback:
        raise TelemetryError(
            f"telemetry endpoint {endpoint!r}: only loopback is allowed without certificates"
        )
    return match[2], int(match[3])


def open_session(
    *, listen: Sequence[str] = (), connect: Sequence[str] = (), certificates: str | Path = ""
) -> Session:
    """Opens a session that listens and connects at these endpoints, and nowhere else.

    With a folder of `certificates` all is mutual TLS and whatever its access rules do not name is
    refused; without, only loopback is spoken to.

    A listening port 0 stands for any free one. A peer that is not there yet is tried again in the
    background. Raises `TelemetryError` with one line, for one when an endpoint is in use.
    """
    import zenoh

    held = credentials.load(certificates) if str(certificates) else None
    for endpoint in connect:
        check_endpoint(endpoint, certified=held is not None)
    for attempt in range(_ATTEMPTS):
        endpoints = [_with_port(endpoint, held is not None) for endpoint in listen]
        try:
            return Session(zenoh.open(session_config(endpoints, connect, held)), tuple(endpoints))
        except zenoh.ZError as error:
            in_use = "in use" in str(error)
            # Another program may take the free port between choosing and opening it.
            if in_use and endpoints != list(listen) and attempt + 1 < _ATTEMPTS:
                continue
            reason = "the port is in use" if in_use else str(error).splitlines()[0][:160]
            where = ", ".join([*endpoints, *connect]) or "no endpoint"
            raise TelemetryError(f"telemetry at {where}: {reason}") from None
    raise AssertionError("unreachable")


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
) -> Any:
    """The `zenoh.Config` of a session that listens and connects at these endpoints only."""
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
    }
    if held is not None:
        settings |= credentials.tls_settings(held)
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    return config
