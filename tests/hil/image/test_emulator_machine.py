"""The machine's part that needs no board: waiting with a bound, power cuts, what is told."""

import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from emulator_card import Boot
from emulator_machine import Machine

from deploy.errors import DeployError

BOARD = """#!/bin/sh
for word in "$@"; do case $word in file:*serial*) serial=${word#file:};; esac; done
echo "emulator's own word" >&2
printf 'Booting\\r\\n' >"$serial"
"""


def machine(folder: Path, does: str) -> Machine:
    program = folder / "qemu"
    program.write_text(BOARD + does)
    program.chmod(0o755)
    boot = Boot(folder / "kernel", folder / "dtb", folder / "initrd", "root=LABEL=r ro")
    return Machine(folder / "card.img", boot, folder / "logs", qemu=program)


def line_of(board: Machine, word: str, limit_s: float) -> str:
    """The first line on the serial line with a word in it, waited for."""

    def look() -> str | None:
        said = board.log.read_text().splitlines() if board.log.is_file() else []
        return next((line for line in said if word in line), None)

    return board.wait(look, limit_s, f"a line with '{word}'")


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    yield tmp_path


def test_a_line_is_waited_for(folder: Path) -> None:
    with machine(folder, 'sleep 0.3; echo "login ready" >>"$serial"; exec sleep 60') as board:
        board.start()
        assert line_of(board, "login r", 20) == "login ready"
        assert board.running


def test_a_line_that_does_not_come_ends_with_the_logs_tail(folder: Path) -> None:
    with machine(folder, "exec sleep 60") as board:
        board.start()
        line_of(board, "Booting", 20)
        with pytest.raises(DeployError, match="within") as raised:
            line_of(board, "never", 0.3)
    assert "not within 0.3 s: a line with 'never'" in str(raised.value)
    assert "| Booting" in str(raised.value) and "| emulator's own word" in str(raised.value)


def test_a_board_that_goes_off_is_not_waited_for(folder: Path) -> None:
    with machine(folder, "exit 0") as board:
        board.start()
        begun = time.monotonic()
        with pytest.raises(DeployError, match="went off before"):
            line_of(board, "never", 60)
        assert time.monotonic() - begun < 30


def test_its_last_line_before_it_goes_off_counts(folder: Path) -> None:
    with machine(folder, 'echo "Restarting system" >>"$serial"') as board:
        board.start()
        assert "Restarting" in line_of(board, "Restarting", 20)


def test_a_power_cut_ends_it_and_the_next_power_on_has_a_log_of_its_own(folder: Path) -> None:
    with machine(folder, 'echo "pid $$" >>"$serial"; exec sleep 60') as board:
        board.start()
        pid = int(line_of(board, "pid", 20).split()[1])
        with pytest.raises(DeployError, match="on already"):
            board.start()
        board.cut()
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
        first = board.log
        board.start()
        assert int(line_of(board, "pid", 20).split()[1]) != pid
        assert board.log != first and first.is_file()


def test_the_context_takes_the_power_away(folder: Path) -> None:
    with machine(folder, 'echo "pid $$" >>"$serial"; exec sleep 60') as board:
        board.start()
        pid = int(line_of(board, "pid", 20).split()[1])
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_an_emulator_that_is_not_there_is_one_line(folder: Path) -> None:
    boot = Boot(folder / "kernel", folder / "dtb", None, "")
    board = Machine(folder / "card.img", boot, folder, qemu=folder / "none")
    with pytest.raises(DeployError, match=r"tools\.sh"):
        board.start()


def test_the_kernel_line_keeps_the_cards_words_and_ends_with_the_console(folder: Path) -> None:
    boot = Boot(folder / "kernel", folder / "dtb", folder / "initrd", "root=LABEL=r ro")
    board = Machine(
        folder / "card.img", boot, folder,
        gauge_file=folder / "gauge", forward={22: 2222}, words="systemd.clock_usec=1",
    )  # fmt: skip
    words = board.command()
    line = words[words.index("-append") + 1].split()
    assert line[:2] == ["root=LABEL=r", "ro"]
    assert "systemd.clock_usec=1" in line and line[-1] == "console=ttyAMA0,115200"
    assert "user,id=net,hostfwd=tcp:127.0.0.1:2222-:22" in words
    assert any("at24c-eeprom" in word and "address=54" in word for word in words)
