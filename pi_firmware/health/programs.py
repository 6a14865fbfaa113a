"""Small programs of the system, run without a shell and never waited for without end."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
from collections.abc import Sequence

from pi_firmware.wire.errors import BlimpError

LIMIT_S = 3.0
_KILLED_LIMIT_S = 0.5
_SYSTEM_FOLDERS = ("/usr/sbin", "/sbin", "/usr/bin", "/bin")  # a user's PATH may lack the first two


class ProgramError(BlimpError):
    """A program that is missing, refuses, or does not end in time."""


def run(words: Sequence[str], limit_s: float = LIMIT_S) -> str:
    """A program's standard output; raises `ProgramError` with one line.

    It runs in a session of its own, so that a Ctrl-C meant for us does not end it halfway. One that
    ignores even SIGKILL, as it hangs inside a driver, is left behind.
    """
    shown = " ".join(words)
    # An empty entry of a PATH would be the folder we stand in.
    folders = [folder for folder in os.environ.get("PATH", "").split(":") if folder]
    path = shutil.which(words[0], path=":".join((*folders, *_SYSTEM_FOLDERS)))
    if path is None:
        raise ProgramError(f"{shown}: {words[0]} is not installed")
    try:
        process = subprocess.Popen(
            [path, *words[1:]],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
    except (OSError, ValueError) as error:
        raise ProgramError(f"{shown}: {error}") from None
    try:
        output, complaint = process.communicate(timeout=limit_s)
    except subprocess.TimeoutExpired:
        _kill(process)
        raise ProgramError(f"{shown}: no end within {limit_s:g} s") from None
    if process.returncode:
        lines = complaint.decode(errors="replace").split("\n")
        reason = lines[0].strip()[:200] or f"exit status {process.returncode}"
        raise ProgramError(f"{shown}: {reason}")
    return output.decode(errors="replace")


def _kill(process: subprocess.Popen[bytes]) -> None:
    with contextlib.suppress(OSError):
        os.killpg(process.pid, signal.SIGKILL)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(_KILLED_LIMIT_S)
    for pipe in (process.stdout, process.stderr):
        if pipe is not None:
            pipe.close()
