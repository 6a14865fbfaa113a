"""Writes an image so that a card is either whole or has no partition table at all.

    1. The first sectors become zeros. From here on the card boots nothing: the Pi's first stage
       finds the boot partition by the table in sector 0, and so does every other machine.
    2. Everything else is written, waited for, read back past the system's memory and compared.
    3. The boot partition is customised and compared, too.
    4. The first sectors follow, sector 0 as the very last: one sector, which a card writes whole
       or not at all.

So power cut, Ctrl-C, a pulled card or a write error between 1 and 4 leave a card that is plainly
empty, never one that boots half of something.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator

from deploy.errors import DeployError, Interrupted
from deploy.flash.bmap import CHUNK_BYTES, Stretch, chunks
from deploy.flash.boot import SECTOR_BYTES
from deploy.flash.image import Image
from deploy.flash.target import Target
from deploy.progress import Progress

# Table and gap before the first partition; an older table of the other kind (GPT) lies there, too.
HEAD_BYTES = 1 << 20
# Waited for so often, so that the bar tells what is on the card and Ctrl-C does not wait long.
_FLUSH_BYTES = 32 << 20
UNKNOWN = "what the card holds now is not known; flash it again"
NOT_BOOTABLE = "the card has no partition table now and does not boot; flash it again"


def write(image: Image, target: Target, customise: Callable[[], object]) -> None:
    """Writes the image, calls `customise`, and makes the card bootable at the very end.

    Raises `DeployError` with one line that says where it failed and what the card is now.
    """
    head = Stretch(0, min(HEAD_BYTES, image.boot.offset))
    body = [part for part in _without(head, image.stretches) if part.start < part.stop]
    stage = _Stage()
    with _never_half(target, stage):
        target.write(0, bytes(head.stop))
        _flush(target, 0)
        stage.table_gone = True
        _write(image, target, body)
        _compare(image, target, body)
        customise()
        first = Stretch(0, SECTOR_BYTES)
        rest = Stretch(SECTOR_BYTES, head.stop)
        for last in (rest, first):
            stage.table_gone = last is rest
            for start, data in chunks(image.file, last):
                target.write(start, data)
            _flush(target, last.start)
        _compare(image, target, [head], quiet=True)


def _without(head: Stretch, stretches: Iterable[Stretch]) -> Iterator[Stretch]:
    for stretch in stretches:
        yield Stretch(max(stretch.start, head.stop), stretch.stop)


class _Stage:
    """Whether zeros are known to stand in sector 0, whatever the card answers from now on."""

    table_gone = False


@contextlib.contextmanager
def _never_half(target: Target, stage: _Stage) -> Iterator[None]:
    try:
        yield
    except BaseException as error:
        known = stage.table_gone or _zero_again(target)
        state = NOT_BOOTABLE if known else UNKNOWN
        if isinstance(error, KeyboardInterrupt | Interrupted):
            raise Interrupted(f"{target.path}: interrupted: {state}") from None
        if isinstance(error, OSError):
            raise DeployError(f"{target.path}: {error.strerror or error}: {state}") from None
        if isinstance(error, DeployError):
            raise DeployError(f"{error}: {state}") from None
        raise


def _zero_again(target: Target) -> bool:
    """Takes sector 0 away, should it be there already; False when that cannot be said."""
    try:
        if target.read(0, SECTOR_BYTES).count(0) != SECTOR_BYTES:
            target.write(0, bytes(SECTOR_BYTES))
            target.flush()
        return target.read(0, SECTOR_BYTES).count(0) == SECTOR_BYTES
    except OSError:
        return False


def _write(image: Image, target: Target, stretches: list[Stretch]) -> None:
    waiting = 0
    with Progress("writing", sum(part.stop - part.start for part in stretches)) as progress:
        for stretch in stretches:
            for start, data in chunks(image.file, stretch):
                try:
                    target.write(start, data)
                except OSError as error:
                    raise _failed(target, "write", start, error) from None
                waiting += len(data)
                if waiting >= _FLUSH_BYTES:
                    _flush(target, start)
                    waiting = 0
                progress.advance(len(data))
        _flush(target, stretches[-1].stop if stretches else 0)


def _compare(
    image: Image, target: Target, stretches: list[Stretch], *, quiet: bool = False
) -> None:
    """Reads back past the system's memory; raises `DeployError` at the first other byte."""
    target.forget()
    total = sum(part.stop - part.start for part in stretches)
    shown = contextlib.nullcontext() if quiet else Progress("reading back", total)
    with shown as progress:
        for stretch in stretches:
            for start, data in chunks(image.file, stretch):
                try:
                    got = target.read(start, len(data))
                except OSError as error:
                    raise _failed(target, "read", start, error) from None
                if got != data:
                    at = start + _first_difference(got, data)
                    raise DeployError(
                        f"{target.path}: byte {at} reads back otherwise than it was written: the"
                        " card or the reader is bad"
                    )
                if progress is not None:
                    progress.advance(len(data))


def _first_difference(one: bytes, other: bytes) -> int:
    size = min(len(one), len(other), CHUNK_BYTES)
    return next((i for i in range(size) if one[i] != other[i]), size)


def _flush(target: Target, start: int) -> None:
    try:
        target.flush()
    except OSError as error:
        raise _failed(target, "write", start, error) from None


def _failed(target: Target, what: str, start: int, error: OSError) -> DeployError:
    reason = error.strerror or error
    return DeployError(f"{target.path}: {what} error at about byte {start}: {reason}")
