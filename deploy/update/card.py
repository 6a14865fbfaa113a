"""The card at the other end of SSH: asks it, gives it a bundle, waits for what becomes of it."""

from __future__ import annotations

import contextlib
import json
import shlex
import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from deploy.errors import DeployError, printable
from deploy.run import need
from deploy.update import bundle as bundles
from deploy.update.bundle import Bundle

# Its own sudo keeps no environment; nothing is written beside the programs of a read-only card.
_PROGRAM = (
    "sudo -n /usr/bin/env PYTHONPATH=/usr/lib/blimp PYTHONDONTWRITEBYTECODE=1"
    " /usr/bin/python3 -m deploy.board.releases"
)
_ASK_S = 60.0
_END_S = 900.0  # writing, reading back and compiling on a slow board
_POLL_S = 3.0
_MOST_BYTES = 1 << 20  # of an answer
_MOST_TRIES = 3  # MaxAuthTries of the card's sshd
_SLACK_S = 60.0  # a payload whose radio comes back late
_OPTIONS = (
    "BatchMode=yes",
    "ConnectTimeout=15",
    "ServerAliveInterval=5",
    "ServerAliveCountMax=6",
)


class Card:
    """A payload's card, spoken to by SSH.

    Args:
        name: the payload's id.
        host: its address or name in the network.
        keys: the authority's folder. The host key that it made for the payload is the only one
            that is taken; for a payload without one there, the first that is seen is kept.
        identity: the pilot's private SSH key; None: the ground stations' in that folder, which
            `deploy.flash` lets in, or else those of SSH's agent and configuration.
        port: of its sshd.
        user: who may become root there without a password.
    """

    def __init__(
        self,
        name: str,
        host: str,
        keys: Path,
        identity: Path | None = None,
        port: int = 22,
        user: str = "pilot",
    ) -> None:
        self.name, self.host = name, host
        options = [*_OPTIONS, f"HostKeyAlias={name}", "HashKnownHosts=no", f"Port={port}"]
        self._pinned: tempfile.TemporaryDirectory[str] | None = None
        public = keys / "payload" / name / "ssh_ed25519.pub"
        if public.is_file():
            self._pinned = tempfile.TemporaryDirectory()
            self.known = Path(self._pinned.name) / "known_hosts"
            self.known.write_text(f"{name} {public.read_text()}")
            options.append("StrictHostKeyChecking=yes")
        else:
            self.known = keys / "known_hosts"
            self.known.touch(0o600)
            options.append("StrictHostKeyChecking=accept-new")
        options += [f"UserKnownHostsFile={self.known}", "GlobalKnownHostsFile=/dev/null"]
        self._words = [need("ssh"), "-T", "-l", user]
        for option in options:
            self._words += ["-o", option]
        stations = sorted(keys.glob("ground/*/ssh_ed25519"))[:_MOST_TRIES]
        for path in stations if identity is None else [identity]:
            # Only these: an agent's many keys would use up what the card allows.
            self._words += ["-i", str(path), "-o", "IdentitiesOnly=yes"]

    def ask(self, action: str) -> dict[str, Any]:
        """What the card answers to `status` or `holds`; raises `DeployError` with one line."""
        try:
            done = subprocess.run(
                self._command(action),
                stdin=subprocess.DEVNULL,
                capture_output=True,
                timeout=_ASK_S,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise DeployError(f"{self.host}: no answer within {_ASK_S:g} s") from None
        return self._answer(done.returncode, done.stdout, done.stderr)

    def give(
        self,
        bundle: Bundle,
        held: Mapping[str, str],
        wrote: Callable[[int], None],
        *,
        force: bool = False,
    ) -> dict[str, Any]:
        """Sends a bundle and gives the card's `version` and `id` of the trial ('': in force).

        Raises `DeployError` with the card's own reason when it refuses, and when the link breaks:
        then the card is as it was, or tries the release out, which `status` tells.
        """
        words = self._command("receive", *(["--force"] if force else []))
        with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
            process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=out, stderr=err)
            assert process.stdin
            try:
                # One that refuses in the midst reads no further: its own words are the reason.
                with contextlib.suppress(BrokenPipeError, ConnectionResetError):
                    bundles.write(bundle, process.stdin, held, wrote)
                    process.stdin.close()
                process.wait(_END_S)
            except subprocess.TimeoutExpired:
                limit = f"within {_END_S:g} s"
                raise DeployError(f"{self.host}: the card did not end {limit}") from None
            finally:
                process.kill()
                process.wait()
            out.seek(0)
            err.seek(0)
            return self._answer(process.returncode, out.read(_MOST_BYTES), err.read(_MOST_BYTES))

    def follow(
        self,
        trial: str,
        limit_s: float,
        log: Callable[[str], None],
        sleep: Callable[[float], None] = time.sleep,
        clock: Callable[[], float] = time.monotonic,
    ) -> dict[str, Any]:
        """Waits for the outcome of a trial, which the card gives within `limit_s`.

        Raises `DeployError` when it is not heard in time.

        A link that goes and comes back, as it may while the firmware is restarted, is no end.
        """
        limit_s += _SLACK_S
        until_s, fault = clock() + limit_s, ""
        while clock() < until_s:
            try:
                found = self.ask("status")
            except DeployError as error:
                if str(error) != fault:
                    fault = str(error)
                    log(f"not reached, trying on: {fault}")
            else:
                fault = ""
                last = found.get("last") or {}
                if last.get("id") == trial:
                    return dict(last)
            sleep(_POLL_S)
        raise DeployError(
            f"{self.name}: not heard what became of it within {limit_s:g} s"
            f"{f' ({fault})' if fault else ''}; the card decides by itself, ask again"
        )

    def _command(self, *words: str) -> list[str]:
        return [*self._words, "--", self.host, f"{_PROGRAM} {shlex.join(words)}"]

    def _answer(self, status: int, out: bytes, err: bytes) -> dict[str, Any]:
        lines = [line for line in err.decode(errors="replace").splitlines() if line.strip()]
        if status != 0:
            raise DeployError(self._reason(status, lines))
        try:
            answer = json.loads(out)
        except (ValueError, RecursionError):
            answer = None
        if not isinstance(answer, dict):
            raise DeployError(f"{self.host}: answered {out[:60]!r}; is it a payload's card?")
        return answer

    def _reason(self, status: int, lines: list[str]) -> str:
        if any("HOST IDENTIFICATION HAS CHANGED" in line for line in lines) or any(
            "Host key verification failed" in line for line in lines
        ):
            forget = f"; flashed again without its keys? ssh-keygen -R {self.name} -f {self.known}"
            why = "it has another host key than this payload's"
            return f"{self.host}: {why}{'' if self._pinned else forget}"
        last = printable(lines[-1])[:300] if lines else ""
        if last.startswith("releases: "):
            return f"{self.name} refuses: {last.removeprefix('releases: ')}"
        return f"{self.host}: {last or f'ssh ended with status {status}'}"
