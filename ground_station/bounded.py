"""Programs that read foreign files with libraries which believe what a file claims."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path


def run(
    program: Path, *arguments: str, seconds: float, memory_bytes: int, data: bytes = b""
) -> subprocess.CompletedProcess[bytes]:
    """Runs a Python file with `data` on its standard input; its status and what it printed.

    It may take so much processor time and address space, leaves no core and imports nothing of the
    working directory's.
    """
    limits = [f"--cpu={int(seconds)}", f"--as={memory_bytes}", "--core=0"]
    child = ["prlimit", *limits, sys.executable, "-I", str(program), *arguments]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}  # each thread claims memory
    return subprocess.run(child, input=data, capture_output=True, env=environment)
