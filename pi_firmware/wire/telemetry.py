"""Zenoh sessions as both sides open them: explicit TCP endpoints, no scouting, no shared memory."""

from __future__ import annotations

import ipaddress
import json
import re
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pi_firmware.wire.errors import TelemetryError

PORT = 7447
LOCAL_ENDPOINT = f"tcp/127.0.0.1:{PORT}"
_ENDPOINT = re.compile(r"tcp/(\[[0-9a-fA-F:]+\]|[^\[\]:/]+):(\d{1,5})")
_ATTEMPTS = 5


@dataclass(frozen=True)
class Session:
    """An open Zenoh session and the endpoints it listens on, ephemeral ports filled in."""

    zenoh: Any
    listening: tuple[str, ...]

    def close(self) -> None:
        """Sends what is queued and closes; a second call does nothing."""
        self.zenoh.close()


def check_endpoint(endpoint: str) -> tuple[str, int]:
    """Host and port of `tcp/HOST:PORT`; raises `TelemetryError` with one line.

    Only loopback is taken: beyond it nobody speaks without a certificate, and there are none yet.
    """
    match = _ENDPOINT.fullmatch(endpoint)
    if match is None or int(match[2]) > 65535:
        raise TelemetryError(f"telemetry endpoint {endpoint!r}: expected tcp/HOST:PORT")
    host = match[1].strip("[]")
    try:
        loopback = ipaddress.ip_address(host).is_loopback
    except ValueError:
        loopback = host == "localhost"
    if not loopback:
        raise TelemetryError(
            f"telemetry endpoint {endpoint!r}: only loopback is allowed without certificates"
        )
    return match[1], int(match[2])


def open_session(*, listen: Sequence[str] = (), connect: Sequence[str] = ()) -> Session:
    """Opens a session that listens and connects at these endpoints, and nowhere else.

    A listening port 0 stands for any free one. A peer that is not there yet is tried again in the
    background. Raises `TelemetryError` with one line, for one when an endpoint is in use.
    """
    import zenoh

    for endpoint in connect:
        check_endpoint(endpoint)
    for attempt in range(_ATTEMPTS):
        endpoints = [_with_port(endpoint) for endpoint in listen]
        try:
            return Session(zenoh.open(session_config(endpoints, connect)), tuple(endpoints))
        except zenoh.ZError as error:
            in_use = "in use" in str(error)
            # Another program may take the free port between choosing and opening it.
            if in_use and endpoints != list(listen) and attempt + 1 < _ATTEMPTS:
                continue
            reason = "the port is in use" if in_use else str(error).splitlines()[0][:160]
            where = ", ".join([*endpoints, *connect]) or "no endpoint"
            raise TelemetryError(f"telemetry at {where}: {reason}") from None
    raise AssertionError("unreachable")


def _with_port(endpoint: str) -> str:
    host, port = check_endpoint(endpoint)
    if port:
        return endpoint
    bare = host.strip("[]")
    family = socket.AF_INET6 if ":" in bare else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.bind((bare, 0))
        return f"tcp/{host}:{probe.getsockname()[1]}"


def session_config(listen: Sequence[str], connect: Sequence[str]) -> Any:
    """The `zenoh.Config` of a session that listens and connects at these endpoints only."""
    import zenoh

    config = zenoh.Config()
    settings = {
        "mode": "peer",
        "listen/endpoints": list(listen),
        "connect/endpoints": list(connect),
        "connect/exit_on_failure": False,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        # On one host large payloads would silently go through /dev/shm, which may be small.
        "transport/shared_memory/enabled": False,
    }
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    return config
