"""Runs Debian's tools: a list of words without a shell, and one line when it goes wrong."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path

from deploy.errors import DeployError

# Debian keeps some tools where a plain user's PATH does not look.
_SYSTEM_FOLDERS = ("/usr/local/sbin", "/usr/sbin", "/sbin")


def find(tool: str) -> str | None:
    """The tool's path, also from the system folders; None when it is not installed."""
    folders = [os.environ.get("PATH", os.defpath), *_SYSTEM_FOLDERS]
    return shutil.which(tool, path=os.pathsep.join(folders))


def need(tool: str) -> str:
    """The tool's path; raises `DeployError` that says what installs it when it is missing."""
    path = find(tool)
    if path is None:
        raise DeployError(
            f"{tool}: not found; make setup installs it, make image what an image needs"
        )
    return path


def run(
    words: Sequence[str | Path],
    *,
    input: bytes | None = None,
    env: Mapping[str, str] | None = None,
    cwd: str | Path | None = None,
    timeout_s: float | None = None,
    ok: Sequence[int] = (0,),
    merge: bool = False,
) -> bytes:
    """Runs a tool to its end and gives what it wrote to standard output.

    Args:
        words: the tool and its arguments, no shell between.
        input: its standard input (default: empty).
        env: variables set beside the caller's own; the language is always C.
        cwd: the folder to run in.
        timeout_s: killed after so long (default: never).
        ok: exit statuses that are no failure.
        merge: gives standard error among standard output, for a tool that fails with status 0.

    Raises:
        DeployError: the tool is missing, takes too long or fails; one line with its last words.
    """
    arguments = [str(word) for word in words]
    name = Path(arguments[0]).name
    arguments[0] = need(arguments[0])
    try:
        done = subprocess.run(
            arguments,
            input=input if input is not None else b"",
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT if merge else subprocess.PIPE,
            env={**os.environ, "LC_ALL": "C", **(env or {})},
            cwd=cwd,
            timeout=timeout_s,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise DeployError(f"{name}: not done after {timeout_s:g} s") from None
    except OSError as error:
        raise DeployError(f"{name}: {error.strerror or error}") from None
    if done.returncode not in ok:
        raise DeployError(f"{name}: {_last_line(done)}")
    return done.stdout


def _last_line(done: subprocess.CompletedProcess[bytes]) -> str:
    for stream in (done.stderr or b"", done.stdout):
        lines = [line for line in stream.decode(errors="replace").splitlines() if line.strip()]
        if lines:
            return lines[-1].strip()
    if done.returncode < 0:
        return f"killed by signal {-done.returncode}"
    return f"exit status {done.returncode} and no word"
