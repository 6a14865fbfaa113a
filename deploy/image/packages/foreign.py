"""How a command is started here so that it can run programs of the board's architecture."""

from __future__ import annotations

import os
import platform
import sys
from pathlib import Path

from deploy.errors import DeployError
from deploy.run import need

BINFMT = Path("/proc/sys/fs/binfmt_misc")

_ELF_CLASS_32, _ELF_CLASS_64 = 1, 2

# Debian's architecture: (this machine's name for it, QEMU's name, ELF class, ELF machine).
ARCHITECTURES = {
    "arm64": (("aarch64",), "aarch64", _ELF_CLASS_64, 183),
    "armhf": (("armv7l", "armv8l", "aarch64"), "arm", _ELF_CLASS_32, 40),
    "armel": (("armv7l", "armv8l", "aarch64"), "arm", _ELF_CLASS_32, 40),
}


def prefix(architecture: str) -> list[str]:
    """The words to put before a command so that it can run `architecture`'s programs.

    Empty where the system runs them as it is. Raises `DeployError` where it cannot be had.
    """
    natives = ARCHITECTURES.get(architecture, ((), "", 0, 0))[0]
    if platform.machine() in natives or architecture == _native():
        return []
    if architecture not in ARCHITECTURES:
        raise DeployError(
            f"architecture {architecture}: emulated are {', '.join(sorted(ARCHITECTURES))}"
        )
    if _handled(ARCHITECTURES[architecture][1]):
        return []
    need(interpreter(architecture))
    if os.geteuid() != 0:
        raise DeployError(
            f"programs of {architecture} run here only as root: sudo, or apt-get install "
            "qemu-user-static and binfmt-support on a system of your own"
        )
    return [sys.executable, "-m", "deploy.image.packages.binfmt", architecture]


def environment() -> dict[str, str]:
    """What `prefix`'s command needs in its environment, from whatever folder it is started."""
    return {"PYTHONPATH": str(Path(__file__).parents[3])}


def _native() -> str:
    machines = {"x86_64": "amd64", "aarch64": "arm64", "armv7l": "armhf"}
    return machines.get(platform.machine(), platform.machine())


def interpreter(architecture: str) -> str:
    """The name of the emulator, statically linked so that it works inside a chroot."""
    return f"qemu-{ARCHITECTURES[architecture][1]}-static"


def _handled(qemu: str) -> bool:
    """Whether the system itself has a handler that also works inside a chroot."""
    try:
        rule = (BINFMT / f"qemu-{qemu}").read_text()
    except OSError:
        return False
    words = rule.split()
    flags = next((words[i + 1] for i, word in enumerate(words[:-1]) if word == "flags:"), "")
    return rule.startswith("enabled") and "F" in flags
