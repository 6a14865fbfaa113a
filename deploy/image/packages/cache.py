"""A cache of things that are made once for their inputs, each there whole or not at all."""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from deploy.board.releases.places import sync_folder
from deploy.errors import DeployError
from deploy.image.sparse import sha256

_KEY_DIGITS = 16


def key(*inputs: Any) -> str:
    """A short name for inputs: records, texts, numbers, and files by what is in them."""
    digest = hashlib.sha256()
    for item in inputs:
        digest.update(json.dumps(item, sort_keys=True, default=_plain).encode())
        digest.update(b"\0")
    return digest.hexdigest()[:_KEY_DIGITS]


@contextlib.contextmanager
def made(target: Path) -> Iterator[Path | None]:
    """Makes `target`, a file or a folder, unless it is there.

    Gives None where it is there, else a new folder beside it: what stands in it under the target's
    own name when the block ends is brought to the disk and renamed to it. One process makes,
    others wait for it. Left by an exception, Ctrl-C included, nothing remains.

    Raises:
        DeployError: the cache cannot be written.
    """
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        lock = os.open(target.parent / f".{target.name}.lock", os.O_CREAT | os.O_RDWR, 0o644)
    except OSError as error:
        raise DeployError(f"{target}: {error.strerror}") from None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if target.exists():
            yield None
            return
        with workshop(target) as work:
            yield work
            os.sync()  # all that was made, of which there may be thousands of files
            (work / target.name).rename(target)
            sync_folder(target.parent)
    except OSError as error:
        raise DeployError(f"{error.filename or target}: {error.strerror or error}") from None
    finally:
        os.close(lock)


@contextlib.contextmanager
def workshop(target: Path) -> Iterator[Path]:
    """A folder beside a target, gone afterwards, and with it what a killed process left there.

    One at a time: the caller holds a lock.
    """
    prefix = f".{target.name}.part-"
    for left in target.parent.glob(f"{prefix}*"):
        shutil.rmtree(left, ignore_errors=True)
    with tempfile.TemporaryDirectory(
        prefix=prefix, dir=target.parent, ignore_cleanup_errors=True
    ) as work:
        yield Path(work)


def _plain(item: Any) -> Any:
    """What JSON has for a record, and for a file."""
    return sha256(item) if isinstance(item, Path) else dataclasses.asdict(item)
