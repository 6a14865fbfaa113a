"""The boot partition: what the board's first stages read, and the folder that people touch.

Words of config.txt are the Raspberry Pi's (raspberrypi.com, "config.txt"); the emulator plays the
first stages and reads the same file.
"""

from __future__ import annotations

from deploy.image.tree import Tree
from deploy.provisioning.model import Provisioning, Wifi
from deploy.provisioning.text import render

LABEL = "BLIMPBOOT"
INITRD = "initrd.img"
EXAMPLE = "blimp/blimp-example.toml"

# Started again 10 s after a kernel that gives up; said on the screen, if any, and on no UART: that
# is the autopilot's.
# Raspberry Pi's firmware switches the accounting off that MemoryMax= needs.
_KERNEL_LINE = "rootfstype=ext4 ro rootwait panic=10 fsck.repair=yes cgroup_enable=memory"
_CONSOLES = {"qemu": "console=tty1 modules_load=vivid"}
_REAL_CONSOLE = "console=tty1"

_CONFIG = """\
# What the board starts with. A payload is told about its network in blimp/, not here.
kernel={kernel}
initramfs {initrd} followkernel
{more}\
disable_splash=1
boot_delay=0

# Camera and gauge.
camera_auto_detect=1
dtparam=i2c_arm=on

# The autopilot has the real UART: Bluetooth would take it.
enable_uart=1
dtoverlay=disable-bt

# A system that hangs is started again.
dtparam=watchdog=on
"""

_README = """\
The folder of this payload.

1. Copy blimp-example.toml to blimp.toml and write down there the payload's name and its Wi-Fi.
2. Put the folder certificates/ that `blimp keys payload NAME` made beside it.
3. Put the card into the payload and give it power. It takes the secrets out of this folder, and
   STATUS.txt says what came of it.

`make flash` does 1 and 2 by itself.
"""


def contents(
    board: str, kernel: str, machine: str, tree: Tree, initrd: bytes | None, root: str
) -> Tree:
    """Adds what is ours to the partition's files, which are kernel and board's firmware, in place.

    `kernel` names the kernel's file in the tree, `machine` is as `uname -m` says there, `root` as
    the kernel's line names it.
    """
    more = "arm_64bit=1\n" if machine == "aarch64" else ""
    if board == "qemu":
        more += "device_tree=bcm2837-rpi-3-b.dtb\n"
    tree.write("config.txt", _CONFIG.format(kernel=kernel, initrd=INITRD, more=more))
    tree.write("cmdline.txt", kernel_line(board, root))
    if initrd is not None:
        tree.write(INITRD, initrd)
    add_folder(tree)
    return tree


def kernel_line(board: str, root: str) -> str:
    """cmdline.txt: one line."""
    return f"{_CONSOLES.get(board, _REAL_CONSOLE)} root={root} {_KERNEL_LINE}\n"


def add_folder(tree: Tree) -> None:
    """The folder `blimp/`, with an example of what the flasher would write into it."""
    example = Provisioning("blimp-1", Wifi(b"name of the network", "DE", "its password"))
    tree.folder("blimp")
    tree.write(EXAMPLE, _crlf(render(example)))
    tree.write("blimp/README.txt", _crlf(_README))


def _crlf(text: str) -> str:
    """Line ends that the simplest editor of any laptop shows as such."""
    return text.replace("\n", "\r\n")
