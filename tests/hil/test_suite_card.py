"""What `ssh:` does to a card's service, with a systemd that only takes notes.

The card itself, with its own systemd, is flown by `make hil PAYLOAD=image`.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

BOARD = Path(__file__).with_name("payloads") / "board.py"
SYSTEMCTL = """#!/bin/sh
# State in files: `active` while the service runs, `held` while the flight's own unit does, `calls`
# of all that was asked.
cd "$(dirname "$0")"
echo "$*" >> calls
case "$*" in
  "is-active blimp-hil.service") [ -e held ] && echo active || { echo inactive; exit 3; }; exit ;;
  "start blimp-hil.service")
    touch held; cat "$UNIT_FILE" > unit
    begin=$(sed -n 's/^ExecStart=//p' unit); end=$(sed -n 's/^ExecStopPost=//p' unit)
    (sh -c "$begin"; echo $? > unit-status; sh -c "$end" < /dev/null > ended 2>&1; rm -f held) \
      < /dev/null > /dev/null 2>&1 &
    exit ;;
  show*blimp-hil.service)
    [ "$(cat unit-status)" = 0 ] && echo Result=success ||
      printf 'Result=exit-code\nExecMainStatus=%s\n' "$(cat unit-status)"
    exit ;;
esac
case "$1" in
  is-active) [ -e active ] && echo active || { echo inactive; exit 3; } ;;
  stop) rm -f active ;;
  restart) touch active ;;
  start)
    cat "$DROP_IN" > seen
    echo "payload blimp-1: replay" >> "$LOG"; touch active ;;
  show)
    n=$(grep -c '^show.*payload' calls)
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
board.DROP_IN, board.UNIT_FILE = root / "unit.d/90-hil.conf", root / "units/blimp-hil.service"
board.LINE, board.SAID = board.WORK / "line", board.WORK / "said"
board.RECORDINGS, board.is_card, board.SOURCE = root, lambda: True, b"# sent"
words = board.unit(60)
again = f"{{sys.executable}} {{root}}/driver.py"
board.unit = lambda limit_s: words.replace(f"/usr/bin/python3 -I {{board.WORK}}/board.py", again)
board.main(*sys.argv[1:])
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

    def start(self, *verb: str) -> subprocess.Popen[str]:
        driver = self.root / "driver.py"
        driver.write_text(DRIVER.format(folder=str(BOARD.parent), root=str(self.root)))
        path = f"{self.bin}{os.pathsep}{os.environ['PATH']}"
        log = self.root / "work/firmware.log"
        return subprocess.Popen(
            [sys.executable, driver, *verb],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            env={**os.environ, "PATH": path, "DROP_IN": str(self.drop_in), "LOG": str(log),
                 "UNIT_FILE": str(self.root / "units/blimp-hil.service")},
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


FLIGHT = json.dumps({
    "recording": "a.mcap", "placeholder": "RECORDING", "limit_s": 60, "recordings": "",
    "settings": ["camera.uri=replay:RECORDING"],
})  # fmt: skip


@pytest.mark.parametrize(("result", "status", "ended"), [("success", 0, 0), ("exit-code", 2, 2)])
def test_a_flight_is_a_unit_of_its_own_that_talks_to_the_ground(
    tmp_path: Path, result: str, status: int, ended: int
) -> None:
    card = Card(tmp_path, result=result, status=status)
    (tmp_path / "a.mcap").touch()
    (card.bin / "active").touch()
    fly = card.start("fly", FLIGHT)
    said, errors = fly.communicate(timeout=60)
    assert (fly.returncode, errors) == (0, "")
    told = [json.loads(line) for line in said.splitlines()]
    assert {"line": "payload blimp-1: replay"} in told
    assert told[-1] == {"ended": ended, "result": result, "memory_bytes": 1000, "cpu_ns": 2000}
    recording = tmp_path / "a.mcap"
    assert f'"camera.uri=replay:{recording}"' in (card.bin / "seen").read_text()
    unit = (card.bin / "unit").read_text()
    assert "RuntimeMaxSec=60\n" in unit and "restore\n" in unit
    # As it was: the service runs, nothing of the flight's is left.
    assert card.calls()[-4:] == [
        "daemon-reload", "restart --no-block blimp-payload.service",
        "reset-failed blimp-hil.service", "daemon-reload",
    ]  # fmt: skip
    assert not list((tmp_path / "units").iterdir()) and not (tmp_path / "work").exists()


def test_the_units_error_is_the_grounds_line_and_status(tmp_path: Path) -> None:
    card = Card(tmp_path)
    (tmp_path / "a.mcap").touch()
    (card.bin / "systemctl").write_text(
        SYSTEMCTL.replace("  stop) rm -f active ;;", "  stop) echo 'Access denied' >&2; exit 4 ;;")
    )
    said, errors = (fly := card.start("fly", FLIGHT)).communicate(timeout=60)
    assert (fly.returncode, said) == (2, "")
    assert errors == "board: systemctl stop blimp-payload.service: Access denied\n"


@pytest.mark.parametrize("how", ["hung up", "killed"])
def test_a_flight_whose_ground_goes_is_undone(tmp_path: Path, how: str) -> None:
    card = Card(tmp_path)
    (tmp_path / "a.mcap").touch()
    (card.bin / "endless").touch()
    fly = card.start("fly", FLIGHT)
    assert fly.stdout is not None and "payload blimp-1" in fly.stdout.readline()
    if how == "killed":
        fly.kill()
    fly.communicate(timeout=60)
    until_s = time.monotonic() + 60
    while (card.bin / "held").exists() and time.monotonic() < until_s:
        time.sleep(0.05)
    assert not (card.bin / "held").exists() and not card.drop_in.exists()
    assert not (tmp_path / "work").exists()


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
