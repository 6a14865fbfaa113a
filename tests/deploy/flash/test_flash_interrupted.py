"""Stopped at any moment a card is untouched, without a partition table, or whole; never half."""

from __future__ import annotations

import errno
import os
import pty
import resource
import select
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from card_bench import BOOT_OFFSET, REPOSITORY, Bench, refused, run, tool

from deploy.errors import DeployError, Interrupted
from deploy.flash import customise, image, keys, write
from deploy.flash.boot import BootPartition
from deploy.flash.customise import Content
from deploy.flash.write import Target
from deploy.provisioning.model import Provisioning
from deploy.provisioning.text import parse

SECTOR = 512


class Faulty(Target):
    """A card that fails as told; `fault(what, offset, data)` raises, or gives the data to use."""

    fault: Callable[[str, int, bytes], bytes] = staticmethod(lambda what, offset, data: data)

    def write(self, offset: int, data: bytes) -> None:
        super().write(offset, self.fault("write", offset, data))

    def flush(self) -> None:
        self.fault("flush", 0, b"")
        super().flush()

    def read(self, offset: int, size: int) -> bytes:
        return self.fault("read", offset, super().read(offset, size))


def _flash(bench: Bench, fault: Callable[[str, int, bytes], bytes]) -> None:
    """The program's steps with a card that fails; sector 0 must be zeros afterwards."""
    content = Content(Provisioning("blimp-1"), keys.load(bench.keys, "blimp-1"))
    with image.opened(bench.image, checksum=True) as card, Faulty.open(bench.card) as target:
        assert isinstance(target, Faulty)
        target.fault = fault  # type: ignore[method-assign]
        boot = BootPartition.at(target.fileno(), card.boot.offset, "card")
        write.write(card, target, lambda: customise.customise(target, boot, content))


def _sector(bench: Bench, number: int = 0) -> bytes:
    with open(bench.card, "rb") as card:
        card.seek(number * SECTOR)
        return card.read(SECTOR)


def _is_zero(sector: bytes) -> bool:
    return sector == bytes(SECTOR)


def _at(kind: str, place: int, error: BaseException) -> Callable[[str, int, bytes], bytes]:
    """A fault once, at the first `kind` that reaches `place`."""
    left = [1]

    def fault(what: str, offset: int, data: bytes) -> bytes:
        if what == kind and offset + len(data) > place >= offset and left:
            left.clear()
            raise error
        return data

    return fault


@pytest.mark.parametrize("place", [0, BOOT_OFFSET + 5000, 12 << 20])
@pytest.mark.parametrize("kind", ["write", "read"])
def test_an_error_of_the_card_is_told_and_leaves_no_table(
    bench: Bench, kind: str, place: int
) -> None:
    with pytest.raises(DeployError) as caught:
        _flash(bench, _at(kind, place, OSError(errno.EIO, "Input/output error")))
    line = str(caught.value)
    assert "Input/output error" in line and write.NOT_BOOTABLE in line and "\n" not in line
    assert _is_zero(_sector(bench))


@pytest.mark.parametrize("place", [0, BOOT_OFFSET + 5000, 12 << 20])
def test_a_card_that_is_pulled_out_has_no_table(bench: Bench, place: int) -> None:
    """From then on nothing answers, so that what is there must be known before."""
    gone = []

    def fault(what: str, offset: int, data: bytes) -> bytes:
        if what == "write" and offset + len(data) > place >= offset and any(data):
            gone.append(place)
        if gone:
            raise OSError(errno.EIO, "Input/output error")
        return data

    with pytest.raises(DeployError) as caught:
        _flash(bench, fault)
    # Sector 0 itself, the last one, is written or not: that nobody knows.
    assert str(caught.value).endswith(write.NOT_BOOTABLE if place else write.UNKNOWN)
    assert _is_zero(_sector(bench))


def test_an_error_told_late_leaves_no_table(bench: Bench) -> None:
    """As a system that keeps writes in memory tells it: with a flush, after them."""
    flushes = iter(range(100))

    def fault(what: str, offset: int, data: bytes) -> bytes:
        if what == "flush" and next(flushes) == 1:
            raise OSError(errno.EIO, "Input/output error")
        return data

    with pytest.raises(DeployError, match="write error at about byte"):
        _flash(bench, fault)
    assert _is_zero(_sector(bench))


@pytest.mark.parametrize("place", [7, BOOT_OFFSET + 5000, 12 << 20])
def test_a_bit_that_reads_back_otherwise_is_found(bench: Bench, place: int) -> None:
    def fault(what: str, offset: int, data: bytes) -> bytes:
        if what == "read" and offset <= place < offset + len(data):
            at = place - offset
            return data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]
        return data

    with pytest.raises(DeployError, match=f"byte {place} reads back otherwise"):
        _flash(bench, fault)
    assert place < SECTOR or _is_zero(_sector(bench))


def test_a_card_that_lies_about_its_size_is_found(bench: Bench) -> None:
    """A counterfeit keeps less than it says, and lets what comes after run over the start."""
    real = 12 << 20
    kept = {}

    def fault(what: str, offset: int, data: bytes) -> bytes:
        if what == "write" and offset >= real:
            kept[offset % real] = data
        if what == "read" and offset in kept:
            return kept[offset][: len(data)]
        return data

    with pytest.raises(DeployError, match="the card or the reader is bad"):
        _flash(bench, fault)
    assert _is_zero(_sector(bench))


@pytest.mark.parametrize("place", [BOOT_OFFSET + 5000, 12 << 20, 100])
def test_ctrl_c_leaves_no_table(bench: Bench, place: int) -> None:
    def fault(what: str, offset: int, data: bytes) -> bytes:
        if what == "write" and offset + len(data) > place >= offset and any(data):
            raise KeyboardInterrupt
        return data

    with pytest.raises(Interrupted, match="interrupted: the card has no partition table"):
        _flash(bench, fault)
    assert _is_zero(_sector(bench))


def test_a_fault_while_customising_leaves_no_table(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = BootPartition.write

    def cut(self: BootPartition, path: str, data: bytes) -> None:
        whole(self, path, data[:-1] if path.endswith("key.pem") else data)

    monkeypatch.setattr(BootPartition, "write", cut)
    with pytest.raises(DeployError, match=r"certificates/key\.pem reads back otherwise"):
        _flash(bench, lambda what, offset, data: data)
    assert _is_zero(_sector(bench))


def test_settings_that_stop_halfway_leave_none(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not the old ones with some of the new: the card says by its light that it has none."""
    assert run(bench.command()).returncode == 0
    whole = BootPartition.write

    def stop(self: BootPartition, path: str, data: bytes) -> None:
        if path.endswith("key.pem"):
            raise DeployError("card: boot partition: it is full")
        whole(self, path, data)

    monkeypatch.setattr(BootPartition, "write", stop)
    content = Content(Provisioning("blimp-2"), keys.load(bench.keys, "blimp-2"))
    with Target.open(bench.card) as target:
        boot = BootPartition.find(target.fileno(), "card")
        with pytest.raises(DeployError, match="it is full"):
            customise.customise(target, boot, content)
    assert "blimp/blimp.toml" not in bench.listed()
    monkeypatch.undo()
    assert run(bench.customise("--payload", "blimp-2", "--no-wifi")).returncode == 0
    assert parse(bench.toml()).payload_id == "blimp-2"


def test_the_program_tells_a_write_error(bench: Bench) -> None:
    """A limit on the size of files stands for a card that takes no more: EFBIG from the kernel."""
    limit = 14 << 20

    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    done = subprocess.run(
        bench.command(), cwd=REPOSITORY, capture_output=True, text=True, preexec_fn=limited,
        timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    line = done.stderr.strip().splitlines()[-1]
    assert "write error at about byte" in line and "File too large" in line
    assert line.endswith(write.NOT_BOOTABLE)
    assert _is_zero(_sector(bench))
    refused(bench.customise(), "not a card image (no partition table")


def _stopped(bench: Bench) -> Iterator[subprocess.Popen[str]]:
    """The program, held where the table is gone and the rest not there yet; again if missed."""
    for _ in range(8):
        bench.card.write_bytes(b"o" * bench.card.stat().st_size)
        program = subprocess.Popen(
            bench.command(), cwd=REPOSITORY, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            text=True,
        )  # fmt: skip
        until = time.monotonic() + 60
        while not _is_zero(_sector(bench)) and program.poll() is None:
            assert time.monotonic() < until
        program.send_signal(signal.SIGSTOP)
        if program.poll() is None and _is_zero(_sector(bench)):
            yield program
        program.kill()
        program.communicate()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_in_the_middle_is_told(bench: Bench, number: signal.Signals) -> None:
    for program in _stopped(bench):
        program.send_signal(number)
        program.send_signal(signal.SIGCONT)
        _, said = program.communicate(timeout=60)
        if program.returncode == 0:  # it was at its end
            continue
        assert program.returncode == 130, said
        assert "interrupted: the card has no partition table now" in said.splitlines()[-1]
        assert "Traceback" not in said
        assert _is_zero(_sector(bench))
        return
    pytest.fail("never caught in the middle")


def test_a_kill_in_the_middle_leaves_no_table(bench: Bench) -> None:
    for program in _stopped(bench):
        program.kill()
        program.communicate(timeout=60)
        assert _is_zero(_sector(bench))
        # And the next flash fixes it.
        assert run(bench.command()).returncode == 0
        assert parse(bench.toml()).payload_id == "blimp-1"
        return
    pytest.fail("never caught in the middle")


def test_before_each_write_it_is_untouched_tableless_or_all_but_its_first_sector(
    bench: Bench,
) -> None:
    """What a kill leaves is what was written by then: the table is the last of it."""
    before = bench.card.read_bytes()
    image_bytes = bench.image.read_bytes()
    seen: list[tuple[int, bool]] = []

    def fault(what: str, offset: int, data: bytes) -> bytes:
        if what == "write":
            assert seen or bench.card.read_bytes() == before
            seen.append((offset, _is_zero(_sector(bench))))
            if offset == 0 and any(data):
                card = bench.card.read_bytes()
                for start, stop in (
                    (SECTOR, BOOT_OFFSET),
                    (9 << 20, 17 << 20),
                    (19 << 20, 23 << 20),
                ):
                    assert card[start:stop] == image_bytes[start:stop]
                assert parse(bench.toml()).payload_id == "blimp-1"
        return data

    _flash(bench, fault)
    offsets, tableless = zip(*seen, strict=True)
    assert offsets[0] == offsets[-1] == 0 and offsets.count(0) == 2
    assert not tableless[0] and all(tableless[1:]) and len(seen) > 4
    assert _sector(bench) == image_bytes[:SECTOR]


def test_a_password_is_typed_without_an_echo(bench: Bench) -> None:
    words = bench.command("--wifi-ssid", "hall", "--country", "DE", wifi=False)
    child, terminal = pty.fork()
    if child == 0:
        os.chdir(REPOSITORY)
        os.execv(words[0], words)
    try:
        said = _until(terminal, b"card's): ")
        os.write(terminal, b'a "hidden word" $(one)\n')
        said += _until(terminal, b"more: ")
        os.write(terminal, b'a "hidden word" $(one)\n')
        said += _until(terminal, b"read back and the same")
    finally:
        os.close(terminal)
        os.waitpid(child, 0)
    assert b"hidden word" not in said, said
    assert b"writing" in said, said
    told = parse(bench.toml())
    assert told.wifi is not None and told.wifi.password == 'a "hidden word" $(one)'


def _until(terminal: int, end: bytes) -> bytes:
    said = b""
    until = time.monotonic() + 60
    while end not in said:
        assert time.monotonic() < until, said
        if select.select([terminal], [], [], 0.2)[0]:
            said += os.read(terminal, 4096)
    return said


def test_a_real_device_is_written_and_read_back(bench: Bench) -> None:
    """A loop device in a card's place: opened exclusively, read directly, table taken again."""
    size = bench.card.stat().st_size // 4096 * 4096
    os.truncate(bench.card, size)
    done = subprocess.run(
        ["losetup", "--find", "--show", bench.card], capture_output=True, text=True, check=False
    )
    if done.returncode:
        pytest.skip(f"no loop device here: {done.stderr.strip()}")
    device = Path(done.stdout.strip())
    content = Content(Provisioning("blimp-1"), keys.load(bench.keys, "blimp-1"))
    try:
        with image.opened(bench.image, checksum=True) as card, Target.open(device) as target:
            assert target.is_device and target.size == size
            with pytest.raises(DeployError, match="in use by the system or another program"):
                Target.open(device)
            boot = BootPartition.at(target.fileno(), card.boot.offset, "card")
            write.write(card, target, lambda: customise.customise(target, boot, content))
            target.reread_table()
        tool("blockdev", "--flushbufs", str(device))
    finally:
        subprocess.run(["losetup", "--detach", device], check=True)
    assert parse(bench.toml()).payload_id == "blimp-1"
    assert bench.card.read_bytes()[:BOOT_OFFSET] == bench.image.read_bytes()[:BOOT_OFFSET]
