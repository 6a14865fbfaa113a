"""What `ssh:` does to a card's service, with a systemd that only takes notes.

The card itself, with its own systemd, is flown by `make hil PAYLOAD=image`.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

BOARD = Path(__file__).with_name("payloads") / "board.py"
SYSTEMCTL = """#!/bin/sh
# State in files: `active` while the service runs, `calls` of all that was asked.
cd "$(dirname "$0")"
echo "$*" >> calls
case "$1" in
  is-active) [ -e active ] && echo active || { echo inactive; exit 3; } ;;
  stop) rm -f active ;;
  restart) touch active ;;
  start)
    cat "$DROP_IN" > seen
    echo "payload blimp-1: replay" >> "$LOG"; touch active ;;
  show)
    n=$(grep -c '^show' calls)
    if [ "$n" -lt 3 ] || [ -e endless ]; then echo ActiveState=active
    else rm -f active; printf 'ActiveState=inactive\\nResult=%s\\nExecMainStatus=%s\\n' \\
      "$(cat result)" "$(cat status)"; fi
    printf 'MemoryPeak=1000\\nCPUUsageNSec=2000\\n' ;;
esac
"""
DRIVER = """
import sys
sys.path.insert(0, {folder!r})
import board
from pathlib import Path
root = Path({root!r})
board.WORK, board.LOG = root / "work", root / "work/firmware.log"
board.DROP_IN = root / "unit.d/90-hil.conf"
board.main(sys.argv[1])
"""


class Card:
    """A card's folders and its noting systemd."""

    def __init__(self, root: Path, *, result: str = "success", status: int = 0) -> None:
        self.root, self.bin = root, root / "bin"
        self.bin.mkdir()
        (self.bin / "systemctl").write_text(SYSTEMCTL)
        (self.bin / "systemctl").chmod(0o755)
        (self.bin / "result").write_text(result)
        (self.bin / "status").write_text(str(status))
        (root / "work").mkdir()
        self.drop_in = root / "unit.d/90-hil.conf"

    def spec(self, *, was_active: bool) -> None:
        told = {"settings": ["camera.uri=replay:/data/hil/a.mcap"], "was_active": was_active}
        (self.root / "work/spec.json").write_text(json.dumps(told))

    def start(self, verb: str) -> subprocess.Popen[str]:
        path = f"{self.bin}{os.pathsep}{os.environ['PATH']}"
        log = self.root / "work/firmware.log"
        return subprocess.Popen(
            [sys.executable, "-c", DRIVER.format(folder=str(BOARD.parent), root=str(self.root)),
             verb],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            env={**os.environ, "PATH": path, "DROP_IN": str(self.drop_in), "LOG": str(log)},
        )  # fmt: skip

    def calls(self) -> list[str]:
        lines = (self.bin / "calls").read_text().splitlines()
        return [line for line in lines if not line.startswith(("show", "is-active"))]


@pytest.mark.parametrize(("result", "status", "ended"), [("success", 0, 0), ("exit-code", 2, 2)])
def test_the_cards_own_service_flies_the_recording(
    tmp_path: Path, result: str, status: int, ended: int
) -> None:
    card = Card(tmp_path, result=result, status=status)
    card.spec(was_active=True)
    hold = card.start("hold")
    assert hold.stdout is not None
    told = [json.loads(line) for line in hold.stdout]
    assert hold.wait(60) == 0
    assert {"line": "payload blimp-1: replay"} in told
    assert told[-1] == {"ended": ended, "result": result, "memory_bytes": 1000, "cpu_ns": 2000}
    seen = (card.bin / "seen").read_text()
    assert '"--set" "camera.uri=replay:/data/hil/a.mcap"' in seen and "Restart=no" in seen
    assert card.calls() == [
        "stop blimp-payload.service", "daemon-reload", "start --no-block blimp-payload.service",
    ]  # fmt: skip


def test_a_line_that_ends_ends_the_watch(tmp_path: Path) -> None:
    card = Card(tmp_path)
    card.spec(was_active=True)
    (card.bin / "endless").touch()
    hold = card.start("hold")
    assert hold.stdout is not None and "payload blimp-1" in hold.stdout.readline()
    assert hold.stdin is not None
    hold.stdin.close()
    assert hold.wait(60) == 0
    assert card.drop_in.is_file()  # to be undone by the unit's end, whatever that was


@pytest.mark.parametrize("was_active", [True, False])
def test_the_card_is_left_as_it_was(tmp_path: Path, was_active: bool) -> None:
    card = Card(tmp_path)
    card.spec(was_active=was_active)
    card.drop_in.parent.mkdir()
    card.drop_in.write_text("[Service]\n")
    assert card.start("restore").wait(60) == 0
    assert not card.drop_in.parent.exists() and not (tmp_path / "work").exists()
    verb = "restart" if was_active else "stop"
    assert card.calls() == ["daemon-reload", f"{verb} --no-block blimp-payload.service"]
    assert (card.bin / "active").exists() == was_active


def test_it_is_restored_also_where_nobody_knows_how_it_was(tmp_path: Path) -> None:
    card = Card(tmp_path)
    assert card.start("restore").wait(60) == 0
    assert (card.bin / "active").exists()
