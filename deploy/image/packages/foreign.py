"""Runs programs of the board's architecture here, by emulation where this machine is another.

    python -m deploy.image.packages.foreign arm64 chroot ROOT python3 -V

That command gets a user and a mount namespace of its own with a private binfmt_misc (Linux 6.7), so
that nothing of the system's is touched. Needs root and qemu-user-static. Whatever takes minutes has
its words in a log file, its steps told to a person, and ends cleanly at Ctrl-C (`run_long`).
"""

from __future__ import annotations

import ctypes
import os
import platform
import re
import signal
import struct
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from deploy.errors import DeployError
from deploy.run import find, need

BINFMT = Path("/proc/sys/fs/binfmt_misc")

_ALL_IDS = 65536

# mount(2), sched.h, elf.h, prctl.h.
_MS_REC, _MS_PRIVATE = 1 << 14, 1 << 18
_CLONE_NEWNS, _CLONE_NEWUSER = 0x20000, 0x10000000
_ELF_CLASS_32, _ELF_CLASS_64 = 1, 2
_ELF_LITTLE_ENDIAN = 1
_ET_EXEC = 2
_PR_SET_PDEATHSIG = 1

# Debian's architecture: (this machine's name for it, QEMU's name, ELF class, ELF machine).
ARCHITECTURES = {
    "amd64": (("x86_64",), "x86_64", _ELF_CLASS_64, 62),
    "arm64": (("aarch64",), "aarch64", _ELF_CLASS_64, 183),
    "armhf": (("armv7l", "armv8l", "aarch64"), "arm", _ELF_CLASS_32, 40),
}


def prefix(architecture: str) -> list[str]:
    """The words to put before a command so that it can run `architecture`'s programs.

    Empty where the system runs them as it is. Raises `DeployError` where it cannot be had.
    """
    if architecture not in ARCHITECTURES:
        raise DeployError(
            f"architecture {architecture}: emulated are {', '.join(sorted(ARCHITECTURES))}"
        )
    natives, qemu, *_ = ARCHITECTURES[architecture]
    if platform.machine() in natives or _handled(qemu):
        return []
    need(interpreter(architecture))
    if os.geteuid() != 0:
        raise DeployError(
            f"programs of {architecture} run here only as root: sudo, or apt-get install "
            "qemu-user-static and binfmt-support on a system of your own"
        )
    return [sys.executable, "-m", "deploy.image.packages.foreign", architecture]


def environment() -> dict[str, str]:
    """What `prefix`'s command needs in its environment, from whatever folder it is started."""
    return {"PYTHONPATH": str(Path(__file__).parents[3])}


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


def elf_rule(name: str, elf_class: int, machine: int, emulator: str) -> bytes:
    """A line for binfmt_misc's `register` (Linux, admin-guide/binfmt-misc): little-endian ELF
    executables, fixed or relocatable, of any system's ABI, of one machine.

    Flags: the caller's argv[0] and credentials are kept, and the interpreter is opened now (`F`),
    so that it needs no copy in a chroot.
    """
    ident = struct.pack("<4sBBB9x", b"\x7fELF", elf_class, _ELF_LITTLE_ENDIAN, 1)
    magic = ident + struct.pack("<HH", _ET_EXEC, machine)
    mask = b"\xff" * 7 + b"\x00" + b"\xff" * 8 + b"\xfe\xff" + b"\xff\xff"
    return f":{name}:M::{_escaped(magic)}:{_escaped(mask)}:{emulator}:OCPF".encode()


def _escaped(data: bytes) -> str:
    return "".join(f"\\x{byte:02x}" for byte in data)


def _enter(architecture: str) -> None:
    """Registers the interpreter in this process's own namespaces."""
    libc = ctypes.CDLL(None, use_errno=True)

    def check(result: int, what: str) -> None:
        if result != 0:
            raise DeployError(f"{what}: {os.strerror(ctypes.get_errno())}")

    libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    check(libc.mount(b"none", b"/", None, _MS_REC | _MS_PRIVATE, None), "a mount namespace")
    mounted = libc.mount(b"binfmt_misc", os.fsencode(BINFMT), b"binfmt_misc", 0, None)
    check(mounted, "a private binfmt_misc (Linux 6.7)")
    program = need(interpreter(architecture))
    _, qemu, elf_class, machine = ARCHITECTURES[architecture]
    try:
        (BINFMT / "register").write_bytes(elf_rule(f"qemu-{qemu}", elf_class, machine, program))
    except OSError as error:
        raise DeployError(f"binfmt_misc: {error.strerror}") from None


def _child(architecture: str, words: list[str], ready: int, go: int) -> int:
    libc = ctypes.CDLL(None, use_errno=True)
    try:
        if libc.unshare(_CLONE_NEWUSER | _CLONE_NEWNS) != 0:
            raise DeployError(f"namespaces: {os.strerror(ctypes.get_errno())}")
        os.write(ready, b"1")
        if os.read(go, 1) != b"1":
            return 2
        os.setresgid(0, 0, 0)
        os.setresuid(0, 0, 0)
        _enter(architecture)
        os.execvp(words[0], words)
    except DeployError as error:
        print(f"foreign: {error}", file=sys.stderr)
    except OSError as error:
        print(f"foreign: {words[0]}: {error.strerror}", file=sys.stderr)
    return 2


def main(arguments: list[str]) -> int:
    """Runs `arguments[1:]` with the programs of architecture `arguments[0]`; its exit status."""
    if len(arguments) < 2 or arguments[0] not in ARCHITECTURES:
        known = "|".join(sorted(ARCHITECTURES))
        print(f"foreign: an architecture ({known}) and a command", file=sys.stderr)
        return 2
    ready_read, ready_write = os.pipe()
    go_read, go_write = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(ready_read)
        os.close(go_write)
        os._exit(_child(arguments[0], arguments[1:], ready_write, go_read))
    os.close(ready_write)
    os.close(go_read)
    # Ctrl-C reaches the command by itself; this one waits for its end.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda number, _: os.kill(child, number))
    if os.read(ready_read, 1) == b"1":
        try:
            for kind in ("uid", "gid"):
                Path(f"/proc/{child}/{kind}_map").write_text(f"0 0 {_ALL_IDS}")
            os.write(go_write, b"1")
        except OSError as error:
            print(f"foreign: user ids: {error.strerror} (root?)", file=sys.stderr)
    os.close(go_write)
    _, status = os.waitpid(child, 0)
    code = os.waitstatus_to_exitcode(status)
    return code if code >= 0 else 128 - code


# mmdebstrap and apt say a step after `I:` and a fault after `E:`.
_STEP = re.compile(r"^I: (?P<what>.+?)\.*$")
_FAULT = re.compile(r"^E: (?P<what>.+)$")
_END_S = 30.0
_TICK_S = 0.5


def run_long(
    words: Sequence[str | Path], log: Path, label: str, env: Mapping[str, str] | None = None
) -> None:
    """Runs a tool to its end, everything it says in `log`.

    Its steps stand on standard error. Stopped by Ctrl-C or SIGTERM's exception, the tool and its
    children are told to clean up and end, and after half a minute made to.

    Raises:
        DeployError: the tool is missing or fails; one line with what it said was wrong.
    """
    arguments = [str(word) for word in words]
    arguments[0] = need(arguments[0])
    if dies_with_us := find("setpriv"):
        # Were this program killed, nobody would end the tool and clear its folder.
        arguments = [dies_with_us, "--pdeathsig", "TERM", "--", *arguments]
    environment = {**os.environ, "LC_ALL": "C.UTF-8", **(env or {})}
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
                for found in filter(None, map(_STEP.match, said)):
                    print(f"{label}: {found['what']}", file=sys.stderr, flush=True)
        finally:
            _end(process)
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


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
