"""A machine that the system's `ssh` reaches without a question asked."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ground_station.errors import GroundStationError, InputError

_HOST = r"[A-Za-z0-9._-]+|\[[0-9A-Fa-f:.%\w]+\]"
_TARGET = re.compile(rf"(?:([A-Za-z0-9._-]+)@)?({_HOST})(?::([0-9]{{1,5}}))?", re.ASCII)


class SshError(GroundStationError):
    """The other machine is not reached, refuses, or breaks off; one line."""


@dataclass(frozen=True)
class Target:
    """Where to, and by which keys; None is what the user's own SSH configuration says."""

    host: str
    user: str | None = None
    port: int | None = None
    identity: Path | None = None
    known_hosts: Path | None = None
    ssh_config: Path | None = None

    @classmethod
    def parse(cls, text: str, **keys: Any) -> Target:
        """Of `[user@]host[:port]`; raises `InputError`."""
        found = _TARGET.fullmatch(text)
        user, host, port = found.groups() if found else (None, "-", None)
        if host.startswith("-") or (user or "").startswith("-") or not 0 < int(port or 1) < 65536:
            raise InputError(f"ssh:{text[:80]}: expected ssh:user@host or ssh:user@host:port")
        return cls(host.strip("[]"), user, int(port) if port else None, **keys)

    def words(self) -> list[str]:
        """The command up to the remote one. Host keys are those known, none is taken unseen."""
        words = ["ssh", "-T"]
        if self.ssh_config:
            words += ["-F", str(self.ssh_config)]
        options = ["BatchMode=yes", "StrictHostKeyChecking=yes", "ConnectTimeout=20"]
        options += ["ServerAliveInterval=5", "ServerAliveCountMax=6", "ControlPath=none"]
        if self.known_hosts:
            options += [f"UserKnownHostsFile={self.known_hosts}", "GlobalKnownHostsFile=/dev/null"]
        if self.identity:
            words += ["-i", str(self.identity)]
            options.append("IdentitiesOnly=yes")
        for option in options:
            words += ["-o", option]
        if self.user:
            words += ["-l", self.user]
        if self.port:
            words += ["-p", str(self.port)]
        return [*words, "--", self.host]


def reason(host: str, code: int, errors: bytes) -> str:
    """One line of why a command over SSH failed."""
    text = errors.decode(errors="replace")
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    if "HOST IDENTIFICATION HAS CHANGED" in text:
        return f"{host}: has another host key than the known one"
    if "Host key verification failed" in text:
        return f"{host}: its host key is not known; log in once by hand, or give --known-hosts"
    last = lines[-1] if lines else f"ssh ended with status {code} and no word"
    clean = "".join(c if c.isprintable() else "?" for c in last)[:300].removeprefix("board: ")
    return clean if clean.startswith(f"{host}:") else f"{host}: {clean}"


def parsed(line: bytes) -> dict[str, Any] | None:
    """A JSON object of one line; None for anything else."""
    try:
        told = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return told if isinstance(told, dict) else None
