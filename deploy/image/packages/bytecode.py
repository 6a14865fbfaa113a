"""Makes Python's byte code in a root file system stand by itself, whatever its sources' times are.

    python -m deploy.image.packages.bytecode ROOT

A `.pyc` names the time of its source, and one that doesn't match is compiled again: at each start
on a read-only root, and whenever the image's times are clamped. PEP 552 lets it name the source's
hash instead, and not look.
"""

from __future__ import annotations

import sys
from pathlib import Path

_HEADER_BYTES = 16
_MAGIC_BYTES = 4
_UNCHECKED_HASH = (1).to_bytes(4, "little")
# What PEP 552 fills with the source's hash; nobody compares it in an unchecked file.
_NO_HASH = bytes(8)


def unchecked(data: bytes) -> bytes:
    """A `.pyc` file's bytes with a header (PEP 552) that asks for no comparison with its source."""
    return data[:_MAGIC_BYTES] + _UNCHECKED_HASH + _NO_HASH + data[_HEADER_BYTES:]


def settle(root: Path) -> int:
    """Rewrites every cached `.pyc` under `root`; how many there are."""
    count = 0
    for path in sorted(root.glob("usr/**/__pycache__/*.pyc")):
        data = path.read_bytes()
        if len(data) > _HEADER_BYTES and not path.is_symlink():
            path.write_bytes(unchecked(data))
            count += 1
    return count


if __name__ == "__main__":
    settle(Path(sys.argv[1]))
