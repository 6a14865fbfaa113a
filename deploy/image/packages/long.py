"""Runs a tool that takes minutes: its words in a log file, its steps to a person, Ctrl-C clean."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from deploy.errors import DeployError
from deploy.run import find, need

# mmdebstrap and apt say a step after `I:` and a fault after `E:`.
_STEP = re.compile(r"^I: (?P<what>.+?)\.*$")
_FAULT = re.compile(r"^E: (?P<what>.+)$")
_END_S = 30.0
_TICK_S = 0.5


def run_long(
    words: Sequence[str | Path], log: Path, label: str, env: Mapping[str, str] | None = None
) -> None:
    """Runs a tool to its end, everything it says in `log`.

    Its steps stand on standard error: one line that is written over on a terminal, else a line
    each. Stopped by Ctrl-C or SIGTERM's exception, the tool and its children are told to clean up
    and end, and after half a minute made to.

    Raises:
        DeployError: the tool is missing or fails; one line with what it said was wrong.
    """
    arguments = [str(word) for word in words]
    arguments[0] = need(arguments[0])
    if dies_with_us := find("setpriv"):
        # Were this program killed, nobody would end the tool and clear its folder.
        arguments = [dies_with_us, "--pdeathsig", "TERM", "--", *arguments]
    environment = {**os.environ, "LC_ALL": "C.UTF-8", **(env or {})}
    start_s = time.monotonic()
    terminal = sys.stderr.isatty()
    step = ""
    with log.open("wb") as out, log.open("r", errors="replace") as said:
        process = subprocess.Popen(
            arguments,
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,
        )
        try:
            ended = False
            while not ended:
                ended = _waited(process)
                for line in said:
                    found = _STEP.match(line)
                    if found and found["what"] != step:
                        step = found["what"]
                        if not terminal:
                            print(f"{label}: {step}", file=sys.stderr, flush=True)
                if terminal:
                    passed = f"{label}: {time.monotonic() - start_s:.0f} s: {step}"
                    print(f"\r\x1b[K{passed[:78]}", end="", file=sys.stderr, flush=True)
        finally:
            _end(process)
            if terminal:
                print("\r\x1b[K", end="", file=sys.stderr, flush=True)
    if process.returncode != 0:
        raise DeployError(f"{label}: {_fault(log, process.returncode)}")


def _waited(process: subprocess.Popen[bytes]) -> bool:
    try:
        process.wait(_TICK_S)
    except subprocess.TimeoutExpired:
        return False
    return True


def _end(process: subprocess.Popen[bytes]) -> None:
    for number in (signal.SIGTERM, signal.SIGKILL):
        if process.poll() is not None:
            return
        os.killpg(process.pid, number)
        try:
            process.wait(_END_S)
        except subprocess.TimeoutExpired:
            continue


def _fault(log: Path, status: int) -> str:
    lines = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
    faults = [found["what"] for line in lines if (found := _FAULT.match(line))]
    # The first fault is the cause; what follows is everything that then failed, too.
    return faults[0] if faults else lines[-1].strip() if lines else f"exit status {status}"
