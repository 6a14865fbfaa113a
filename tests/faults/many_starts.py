"""Starts the payload's program many times, each in a process of its own, at the cost of a fork.

    python tests/faults/many_starts.py < COMMANDS.jsonl

Each line is a list of arguments; each gives a line with status, out and err. What the program
imports for its configuration is imported once, before; all else is as with `python -m pi_firmware`.
"""

from __future__ import annotations

import json
import os
import runpy
import sys
import tempfile
from typing import Any


def start(arguments: list[str]) -> dict[str, Any]:
    """One run to its end."""
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        pid = os.fork()
        if pid == 0:
            os.dup2(out.fileno(), 1)
            os.dup2(err.fileno(), 2)
            sys.argv = ["pi_firmware", *arguments]
            status = 0
            try:
                runpy.run_module("pi_firmware", run_name="__main__")
            except SystemExit as ended:
                status = ended.code if isinstance(ended.code, int) else 1
            except BaseException:
                sys.excepthook(*sys.exc_info())
                status = 1
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)
        status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        texts = []
        for file in (out, err):
            file.seek(0)
            texts.append(file.read().decode())
        return {"status": status, "out": texts[0], "err": texts[1]}


def main() -> None:
    """All of the lines, one after the other."""
    from pi_firmware import autopilot, battery, settings, sources  # noqa: F401

    for line in sys.stdin.readlines():
        print(json.dumps(start(json.loads(line))), flush=True)


if __name__ == "__main__":
    main()
