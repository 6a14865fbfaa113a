"""Libraries between the program and its system that make a fault, for LD_PRELOAD."""

from __future__ import annotations

import mmap
import shutil
import struct
import subprocess
from pathlib import Path

import pytest


class Shim:
    """A C file beside this one, compiled into `folder`, for the programs started with `env`.

    What it does follows a 64-bit number, which `set` changes while they run. Skips the test where
    there is no C compiler.
    """

    def __init__(self, folder: Path, name: str) -> None:
        compiler = shutil.which("cc")
        if compiler is None:
            pytest.skip("no C compiler for a shim")
        source = Path(__file__).with_name(f"{name}.c")
        library, number = folder / f"{name}.so", folder / f"{name}.number"
        subprocess.run(
            [compiler, "-shared", "-fPIC", "-O1", "-o", library, source, "-ldl"], check=True
        )
        number.write_bytes(bytes(16))
        with number.open("r+b") as file:
            self._numbers = mmap.mmap(file.fileno(), 16)
        self.env = {"LD_PRELOAD": str(library), name.upper(): str(number)}

    def set(self, number: int) -> None:
        """From now on it is this number; 0 at first."""
        self._numbers[:8] = struct.pack("=q", number)

    @property
    def befell(self) -> int:
        """How often it made a fault, where it counts them."""
        return int(struct.unpack_from("=q", self._numbers, 8)[0])
