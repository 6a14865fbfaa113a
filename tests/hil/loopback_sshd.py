"""A real sshd on loopback, unprivileged, with throw-away keys: the far end for `ssh:`."""

from __future__ import annotations

import getpass
import os
import shutil
import socket
import subprocess
import time
from pathlib import Path

LIMIT_S = 60.0
SSHD = shutil.which("sshd") or shutil.which("sshd", path="/usr/sbin:/usr/local/sbin")


class LoopbackSshd:
    """A context manager; `target` holds what an `ssh` client needs to know."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
        self.folder, self.user = folder, getpass.getuser()
        self.host_key, self.identity = folder / "host", folder / "user"
        self.known_hosts = folder / "known_hosts"
        for path in (self.host_key, self.identity):
            words = ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", "test", "-f", str(path)]
            subprocess.run(words, check=True, stdin=subprocess.DEVNULL)
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = int(probe.getsockname()[1])
        host_key = self.host_key.with_suffix(".pub").read_text()
        self.known_hosts.write_text(f"[127.0.0.1]:{self.port} {host_key}")
        (folder / "authorized").write_text(self.identity.with_suffix(".pub").read_text())
        (folder / "config").write_text(
            f"ListenAddress 127.0.0.1:{self.port}\n"
            f"HostKey {self.host_key}\n"
            f"AuthorizedKeysFile {folder / 'authorized'}\n"
            f"PidFile {folder / 'pid'}\n"
            # The folder of a test is in /tmp, which is everybody's.
            "StrictModes no\nUsePAM no\nPasswordAuthentication no\n"
            "KbdInteractiveAuthentication no\nAuthenticationMethods publickey\n"
            "PermitRootLogin prohibit-password\nUseDNS no\nLoginGraceTime 120\n"
        )
        (folder / "ssh_config").write_text("")

    def __enter__(self) -> LoopbackSshd:
        assert SSHD is not None
        if os.geteuid() == 0:  # Debian's own start script makes it
            Path("/run/sshd").mkdir(mode=0o755, exist_ok=True)
        self._log = (self.folder / "log").open("wb")
        self.process = subprocess.Popen(
            [SSHD, "-D", "-e", "-f", str(self.folder / "config")],
            stdin=subprocess.DEVNULL, stdout=self._log, stderr=self._log,
        )  # fmt: skip
        until_s = time.monotonic() + LIMIT_S
        while True:
            with socket.socket() as tried:
                if tried.connect_ex(("127.0.0.1", self.port)) == 0:
                    return self
            said = (self.folder / "log").read_text()
            assert self.process.poll() is None and time.monotonic() < until_s, said
            time.sleep(0.05)

    def __exit__(self, *_: object) -> None:
        self.process.terminate()
        self.process.wait(LIMIT_S)
        self._log.close()
