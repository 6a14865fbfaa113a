"""What the card is made of: Debian's packages, a kernel and the firmware's wheels, each verified.

Everything comes through a signature (apt) or a hash (`requirements.lock`), is kept in a cache that
is keyed by its inputs, and appears there whole or not at all. What is cached needs no network.
"""

from deploy.image.packages.base import add_packages
from deploy.image.packages.board import Archive, Board, load_board, with_archives
from deploy.image.packages.kernel import Kernel, unpack_kernel
from deploy.image.packages.python import byte_compile
from deploy.image.packages.rootfs import build_rootfs
from deploy.image.packages.wheels import fetch_wheels

__all__ = [
    "Archive",
    "Board",
    "Kernel",
    "add_packages",
    "build_rootfs",
    "byte_compile",
    "fetch_wheels",
    "load_board",
    "unpack_kernel",
    "with_archives",
]
