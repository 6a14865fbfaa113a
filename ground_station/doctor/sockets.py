"""Who holds a port: Linux's tables of sockets, and the processes that have them open."""

from __future__ import annotations

import contextlib
import errno
import os
import pwd
import socket
from dataclasses import dataclass
from pathlib import Path

_PROC = Path("/proc")
_LISTENING = "0A"  # TCP_LISTEN; a UDP socket that is bound and not connected is 07
_OURS = ("ground_station.service", "blimp serve", "blimp\0serve")


@dataclass(frozen=True)
class Holder:
    """A process that holds a port; `pid` is None where its owner is not ours to look into."""

    user: str
    pid: int | None = None
    command: str = ""

    @property
    def service(self) -> bool:
        """Whether it is the ground station's service."""
        return any(mark in self.command for mark in _OURS) or (
            self.pid is None and self.user == "blimp"
        )

    def __str__(self) -> str:
        if self.pid is None:
            return f"a process of user {self.user}"
        return f"process {self.pid} of user {self.user} ({self.command.replace(chr(0), ' ')[:60]})"


def refusal(kind: int, host: str, port: int) -> OSError | None:
    """Why the port cannot be bound now; None when it can. It is given back at once."""
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=kind)[0]
        with socket.socket(family, kind) as probe:
            if kind == socket.SOCK_STREAM:  # connections that have just ended do not count
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
            if kind == socket.SOCK_STREAM:
                probe.listen(1)
    except OSError as error:
        return error
    return None


def in_use(error: OSError | None) -> bool:
    """Whether the port is somebody's."""
    return error is not None and error.errno == errno.EADDRINUSE


def holders(kind: int, port: int, proc: Path = _PROC) -> list[Holder]:
    """The processes that listen on a port, on whichever address."""
    protocol = "tcp" if kind == socket.SOCK_STREAM else "udp"
    inodes: dict[str, str] = {}
    for name in (protocol, f"{protocol}6"):
        inodes |= _inodes(proc / "net" / name, port, protocol == "tcp")
    found = [holder for inode, user in inodes.items() for holder in _owners(proc, inode, user)]
    return list(dict.fromkeys(found))


def _inodes(path: Path, port: int, tcp: bool) -> dict[str, str]:
    """Inode and user of each socket of a table that is bound to the port."""
    found = {}
    with contextlib.suppress(OSError):  # no IPv6, or none of this protocol
        for line in path.read_text().splitlines()[1:]:
            fields = line.split()
            if len(fields) < 10 or int(fields[1].rpartition(":")[2], 16) != port:
                continue
            if not tcp or fields[3] == _LISTENING:
                found[fields[9]] = _user(int(fields[7]))
    return found


def _owners(proc: Path, inode: str, user: str) -> list[Holder]:
    wanted, found = f"socket:[{inode}]", []
    for process in proc.glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it ended, or is another user's
            if any(_link(fd) == wanted for fd in (process / "fd").iterdir()):
                command = (process / "cmdline").read_text(errors="replace").rstrip("\0")
                found.append(Holder(user, int(process.name), command))
    return found or [Holder(user)]


def _link(path: Path) -> str:
    try:
        return os.readlink(path)  # noqa: PTH115  # its text is no path
    except OSError:
        return ""


def _user(number: int) -> str:
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        return str(number)
