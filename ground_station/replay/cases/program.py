"""Which program made a run: versions, and a hash of the source that every change shows in."""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import platform
from pathlib import Path

import ground_station
import pi_firmware

_LIBRARIES = ("numpy", "scipy", "opencv-python-headless", "gtsam", "av")
"""Those whose next version may give another pose."""


def versions() -> dict[str, str]:
    """Names and versions of what a pose depends on, the machine's kind included."""
    found = {
        "ground_station": f"{ground_station.__version__}, source {source_sha256()[:12]}",
        "pi_firmware": pi_firmware.__version__,
        "python": platform.python_version(),
        "machine": platform.machine(),
    }
    for name in _LIBRARIES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


@functools.cache
def source_sha256() -> str:
    """Of every .py and .toml file of both packages, by name and content."""
    digest = hashlib.sha256()
    for package in (ground_station, pi_firmware):
        root = Path(str(package.__file__)).parent
        for path in sorted(p for p in root.rglob("*") if p.suffix in (".py", ".toml")):
            content = path.read_bytes()
            name = f"{root.name}/{path.relative_to(root).as_posix()}"
            digest.update(f"{name}\0{len(content)}\0".encode() + content)
    return digest.hexdigest()
