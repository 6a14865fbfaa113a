"""Restarts of process and board, counted in a file that outlives both."""

from __future__ import annotations

import dataclasses
import json
import sys
import threading
from dataclasses import dataclass
from pathlib import Path

from pi_firmware.health import small_files
from pi_firmware.wire import files
from pi_firmware.wire.config import from_mapping, key
from pi_firmware.wire.errors import ConfigError

_SCHEMA = "blimp.restarts/1"
_MOST_REBOOTS = 3
_HIGHEST = 10**9
_LONGEST_BOOT_ID = 64


@dataclass(frozen=True)
class _Counts:
    boot_id: str = ""  # the boot in which the file was written
    processes: int = key(0, low=0, high=_HIGHEST)  # started in that boot
    without_frame: int = key(0, low=0, high=_HIGHEST)  # of them the last ones, in a row
    reboots: int = key(0, low=0, high=_HIGHEST)  # asked for and done, since the file was made
    reboots_in_a_row: int = key(0, low=0, high=_HIGHEST)  # asked for since the last frame
    reboot_pending: bool = False


class Restarts:
    """Counts processes that sent no frame, and says when the board should be rebooted.

    `path` is the file; with an empty one nothing is counted and no reboot allowed. `limit`
    processes in a row without a frame allow a reboot, three reboots in a row without one are the
    most: a board that reboots for ever is worse than one that can be reached. A file that is
    absent, old or nonsense counts as zero; it is written beside, synced and renamed. A reboot that
    cannot be counted is not allowed. Nothing raises. Safe from any thread.
    """

    def __init__(self, path: str, limit: int, root: Path = Path("/")) -> None:
        self._path = Path(path) if path else None
        self._limit = limit
        self._boot_id_file = root / "proc/sys/kernel/random/boot_id"
        self._lock = threading.Lock()
        self._counts = _Counts()
        self._begun = self._fresh = self._complained = False

    @property
    def process_restarts(self) -> int:
        """Processes that this boot has seen before this one."""
        return max(self._counts.processes - 1, 0)

    @property
    def board_restarts(self) -> int:
        """Reboots that this class allowed and that happened, since the file was made."""
        return self._counts.reboots

    def begin(self) -> None:
        """Counts this process; once, at its start. Waits for the card."""
        with self._lock:
            if self._path is None or self._begun:
                return
            self._begun = True
            before = _read(self._path)
            boot_id = (small_files.text(self._boot_id_file) or "").strip()[:_LONGEST_BOOT_ID]
            if boot_id != before.boot_id:
                # Nothing has been tried in this boot yet, whoever asked for it.
                before = dataclasses.replace(
                    before,
                    boot_id=boot_id,
                    processes=0,
                    without_frame=0,
                    reboots=before.reboots + before.reboot_pending,
                )
            self._write(
                dataclasses.replace(
                    before,
                    processes=before.processes + 1,
                    without_frame=before.without_frame + 1,
                    reboot_pending=False,
                )
            )

    def fresh(self) -> None:
        """A frame left the encoder: ends both rows.

        The first call writes the file, on a thread of its own; every other one costs nothing.
        """
        if self._fresh or not self._begun:
            return
        with self._lock:
            if self._fresh:
                return
            self._fresh = True
        threading.Thread(target=self._clear, name="restarts", daemon=True).start()

    def claim_reboot(self, *, ending: bool) -> bool:
        """Whether the caller shall reboot the board now; True has been counted, and is due.

        Ask with `ending=False` at the start, when only earlier processes count: those that systemd
        killed could not ask. Ask with `ending=True` when this process gives up, too.
        """
        with self._lock:
            counts = self._counts
            failed = counts.without_frame - (0 if ending else 1)
            if not self._begun or self._fresh or failed < self._limit:
                return False
            if counts.reboots_in_a_row >= _MOST_REBOOTS:
                return False
            claimed = dataclasses.replace(
                counts,
                without_frame=0,
                reboots_in_a_row=counts.reboots_in_a_row + 1,
                reboot_pending=True,
            )
            if not self._write(claimed):
                self._counts = counts
                return False
            return True

    def _clear(self) -> None:
        with self._lock:
            self._write(dataclasses.replace(self._counts, without_frame=0, reboots_in_a_row=0))

    def _write(self, counts: _Counts) -> bool:
        """Takes the counts, and whether they are safe on the card."""
        assert self._path is not None
        self._counts = counts
        document = {"schema": _SCHEMA, **dataclasses.asdict(counts)}
        try:
            files.write(self._path, json.dumps(document).encode() + b"\n")
        except (OSError, ValueError) as error:
            if not self._complained:
                self._complained = True
                print(f"pi_firmware: supervision.state: {error}", file=sys.stderr)
            return False
        return True


def _read(path: Path) -> _Counts:
    try:
        document = json.loads(small_files.text(path) or "")
        if not isinstance(document, dict) or document.pop("schema", None) != _SCHEMA:
            return _Counts()
        return from_mapping(document, _Counts)
    except (ConfigError, ValueError, RecursionError):
        return _Counts()
