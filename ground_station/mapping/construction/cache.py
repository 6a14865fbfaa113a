"""What a build has made already: features and pairs, by content, in one SQLite file.

A build that was killed, or that is run again with another setting, takes from here what it needs
and makes only the rest. Nothing that happens to the file stops a build: a damaged entry is made
again, a damaged file is put aside, and where the disk refuses the build goes on without; each is
said in one line.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import sqlite3
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from ground_station import user_folders
from ground_station.features.extractor import Features
from ground_station.mapping.construction import entries
from ground_station.mapping.construction.entries import Entry, EntryError
from ground_station.mapping.sfm.two_view import TwoView

Out = TypeVar("Out")

_FORMAT = 1
"""In the file's name: a program that keeps another layout has a file of its own."""
_BUSY_S = 30.0
"""Another build writes for milliseconds; one that was stopped in the middle must not stop us."""
_COMMIT_S, _COMMIT_BYTES = 0.1, 16 << 20
"""What is made is on disk at the latest so long, or so much, after it was: a kill costs no more."""
_PRUNED_SHARE = 0.9
"""Of the size allowed, what is left when the oldest entries go: they don't go one by one."""
_TOUCH_S = 3600
"""The last use is kept to the hour, so that reading writes nothing most of the time."""
_MOST_REPAIRS = 2
_DAMAGED = (sqlite3.SQLITE_ERROR, sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)

_TABLE = """
CREATE TABLE entries (
  key BLOB PRIMARY KEY,
  kind INTEGER NOT NULL,
  used_s INTEGER NOT NULL,
  rows INTEGER NOT NULL,
  columns INTEGER NOT NULL,
  digest BLOB NOT NULL,
  data BLOB NOT NULL
)"""


class _LayoutError(sqlite3.DatabaseError):
    """A database that is none of ours."""


@dataclass
class Figures:
    """How much was found and how much had to be made, in images and in pairs of images."""

    features_found: int = 0
    features_made: int = 0
    pairs_found: int = 0
    pairs_made: int = 0
    damaged: int = 0

    def __str__(self) -> str:
        images, pairs = (
            self.features_found + self.features_made,
            self.pairs_found + self.pairs_made,
        )
        return (
            f"features of {self.features_found} of {images} images "
            f"and {self.pairs_found} of {pairs} pairs were there"
        )


@dataclass(frozen=True)
class Known:
    """A pair that was compared before; `view` is None where the images share no geometry."""

    view: TwoView | None


def default_folder() -> Path:
    """`$BLIMP_CACHE`, else `blimp/mapping` where XDG keeps what can be made again."""
    chosen = os.environ.get("BLIMP_CACHE")
    return Path(chosen) if chosen else user_folders.cache() / "mapping"


class Cache:
    """Features and pairs by the hashes of `content`, in `folder`, at most `most_bytes` on disk.

    Several builds may use one folder at a time. For one thread. Close it, or use it in a `with`.
    """

    def __init__(self, folder: str | Path, most_bytes: int = 4_000_000_000) -> None:
        self.folder = Path(folder)
        self.figures = Figures()
        self._path = self.folder / f"mapping-{_FORMAT}.sqlite"
        self._most_bytes = most_bytes
        self._db: sqlite3.Connection | None = None
        self._inode = 0
        self._repairs = 0
        self._pending: dict[bytes, Entry] = {}
        self._pending_bytes = 0
        self._used: set[bytes] = set()
        self._committed_s = -_COMMIT_S
        try:
            self._open()
        except (OSError, sqlite3.Error) as error:
            self._stop(error)

    def features(self, key: bytes) -> Features | None:
        """The features of an image; None where they must be made."""
        found = self._decoded(key, entries.to_features)
        self.figures.features_found += found is not None
        return found

    def keep_features(self, key: bytes, features: Features) -> None:
        """Keeps the features of an image that have been made."""
        self.figures.features_made += 1
        self._put(key, entries.of_features(features))

    def view(self, key: bytes, features: tuple[int, int]) -> Known | None:
        """What was found of a pair of images with so many features; None: compare them."""
        found = self._decoded(key, lambda entry: Known(entries.to_view(entry, features)))
        self.figures.pairs_found += found is not None
        return found

    def keep_view(self, key: bytes, view: TwoView | None) -> None:
        """Keeps what was found of a pair that has been compared."""
        self.figures.pairs_made += 1
        self._put(key, entries.of_view(view))

    def flush(self) -> None:
        """Puts on disk what is not there yet."""
        if self._pending or self._used:
            self._safely(self._write)
        self._committed_s = time.monotonic()

    def close(self) -> None:
        """Puts everything on disk and lets go of the file."""
        self.flush()
        if self._db is not None:
            with contextlib.suppress(sqlite3.Error):
                self._db.close()
        self._db = None

    def __enter__(self) -> Cache:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _put(self, key: bytes, entry: Entry) -> None:
        if self._db is None:
            return
        self._pending[key] = entry
        self._pending_bytes += len(entry.data)
        late = time.monotonic() - self._committed_s >= _COMMIT_S
        if late or self._pending_bytes >= _COMMIT_BYTES:
            self.flush()

    def _decoded(self, key: bytes, decode: Callable[[Entry], Out]) -> Out | None:
        try:
            entry = self._pending.get(key) or self._read(key)
            if entry is None:
                return None
            found = decode(entry)
        except EntryError as error:
            if not self.figures.damaged:
                _log(f"cache: an entry of {self._path} is damaged ({error}) and is made again")
            self.figures.damaged += 1
            return None
        self._used.add(key)
        return found

    def _read(self, key: bytes) -> Entry | None:
        query = "SELECT kind, rows, columns, digest, data FROM entries WHERE key = ?"
        row = self._safely(lambda db: db.execute(query, (key,)).fetchone())
        if row is None:
            return None
        # SQLite keeps a value of any type in any column.
        if [type(value) for value in row] != [int, int, int, bytes, bytes]:
            raise EntryError("not an entry")
        kind, rows, columns, digest, data = row
        entry = Entry(kind, rows, columns, data)
        if _digest(key, entry) != digest:
            raise EntryError("its digest is another")
        return entry

    def _write(self, db: sqlite3.Connection) -> None:
        now_s = int(time.time())
        db.execute("BEGIN IMMEDIATE")
        try:
            db.executemany(
                "INSERT OR REPLACE INTO entries VALUES (?, ?, ?, ?, ?, ?, ?)",
                [
                    (key, e.kind, now_s, e.rows, e.columns, _digest(key, e), e.data)
                    for key, e in self._pending.items()
                ],
            )
            db.executemany(
                "UPDATE entries SET used_s = ? WHERE key = ? AND used_s < ?",
                [(now_s, key, now_s - _TOUCH_S) for key in self._used],
            )
            pruned = self._prune(db)
            db.execute("COMMIT")
        except BaseException:  # Ctrl-C, too: another build waits for the lock
            with contextlib.suppress(sqlite3.Error):
                db.execute("ROLLBACK")
            raise
        self._pending.clear()
        self._used.clear()
        self._pending_bytes = 0
        if pruned:
            db.execute("PRAGMA incremental_vacuum").fetchall()

    def _prune(self, db: sqlite3.Connection) -> bool:
        """Removes what was not used for the longest time, where the file is too large."""
        pages, free, page_bytes = (
            db.execute(f"PRAGMA {name}").fetchone()[0]
            for name in ("page_count", "freelist_count", "page_size")
        )
        if (pages - free) * page_bytes <= self._most_bytes:
            return False
        excess = (pages - free) * page_bytes - _PRUNED_SHARE * self._most_bytes
        old: list[tuple[int]] = []
        cursor = db.execute("SELECT rowid, length(data) FROM entries ORDER BY used_s, rowid")
        for rowid, length in cursor:
            old.append((rowid,))
            excess -= length
            if excess <= 0:
                break
        cursor.close()
        db.executemany("DELETE FROM entries WHERE rowid = ?", old)
        return True

    def _safely(self, work: Callable[[sqlite3.Connection], Out]) -> Out | None:
        """What `work` gives, after a repair where one is needed; None where there is no cache."""
        while self._db is not None:
            try:
                return work(self._db)
            except sqlite3.Error as error:
                self._start_again(error)
        return None

    def _open(self) -> None:
        self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with _alone(self.folder):
            try:
                self._db = _connect(self._path)
            except sqlite3.Error as error:
                if not _is_damage(error):
                    raise
                self._put_aside()
                self._db = _connect(self._path)
            self._inode = self._path.stat().st_ino

    def _start_again(self, error: sqlite3.Error) -> None:
        """Begins a damaged file again; of anything else there is no more cache."""
        if self._db is not None:
            with contextlib.suppress(sqlite3.Error):
                self._db.close()
        self._db = None
        self._repairs += 1
        if not _is_damage(error) or self._repairs > _MOST_REPAIRS:
            self._stop(error)
            return
        try:
            with _alone(self.folder):
                # Another build may have begun it again meanwhile.
                if self._path.exists() and self._path.stat().st_ino == self._inode:
                    self._put_aside()
            self._open()
        except (OSError, sqlite3.Error) as another:
            self._stop(another)

    def _put_aside(self) -> None:
        aside = self._path.with_suffix(".damaged")
        self._path.replace(aside)
        for ending in ("-wal", "-shm"):
            self._path.with_name(self._path.name + ending).unlink(missing_ok=True)
        _log(f"cache: {self._path} is damaged; it is kept as {aside.name} and begun again")

    def _stop(self, error: OSError | sqlite3.Error) -> None:
        reason = error.strerror if isinstance(error, OSError) else error
        _log(f"cache: {self._path}: {reason or error}; the build goes on without it")
        self._pending.clear()
        self._used.clear()


def _connect(path: Path) -> sqlite3.Connection:
    db = sqlite3.connect(path, timeout=_BUSY_S, isolation_level=None)
    try:
        db.execute("PRAGMA auto_vacuum = INCREMENTAL")  # what is pruned leaves the disk
        db.execute("PRAGMA journal_mode = WAL").fetchall()
        # The newest entries may be lost when the power goes, and no others.
        db.execute("PRAGMA synchronous = NORMAL")
        tables = db.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall()
        if not tables:
            db.execute("BEGIN IMMEDIATE")
            db.execute(_TABLE)
            db.execute("CREATE INDEX by_use ON entries (used_s)")
            db.execute(f"PRAGMA user_version = {_FORMAT}")
            db.execute("COMMIT")
        elif db.execute("PRAGMA user_version").fetchone()[0] != _FORMAT:
            raise _LayoutError("not a cache of this program")
    except BaseException:
        db.close()
        raise
    return db


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """No other build opens a cache in this folder, or puts one aside, meanwhile."""
    with (folder / "opening.lock").open("ab") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _is_damage(error: sqlite3.Error) -> bool:
    code = getattr(error, "sqlite_errorcode", None)
    return isinstance(error, _LayoutError) or (code is not None and code & 0xFF in _DAMAGED)


def _digest(key: bytes, entry: Entry) -> bytes:
    head = f"{entry.kind} {entry.rows} {entry.columns}\n".encode()
    return hashlib.blake2b(key + head + entry.data, digest_size=16).digest()


def _log(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
