"""What the payload says of its board: read from trees that stand for the kernel's files."""

import dataclasses
import os
import resource
from pathlib import Path

import pytest

from pi_firmware.health.board import Board, BoardState
from pi_firmware.wire import messages

STAT = "cpu  {user} 0 100 {idle} 50 0 10 0 0 0\ncpu0 1 2 3 4 5 6 7 8 9 10\n"
MEMINFO = "MemTotal:         437384 kB\nMemFree:   1000 kB\nMemAvailable:     250000 kB\n"
FIRMWARE = "sys/devices/platform/soc/soc:firmware/get_throttled"


def write(root: Path, files: dict[str, str | bytes]) -> None:
    for name, content in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content if isinstance(content, bytes) else content.encode())


@pytest.fixture
def zero_w(tmp_path: Path) -> Path:
    """A Pi Zero W that is well."""
    write(
        tmp_path,
        {
            "sys/class/thermal/thermal_zone0/type": "cpu-thermal\n",
            "sys/class/thermal/thermal_zone0/temp": "48312\n",
            "sys/class/thermal/thermal_zone1/type": "cpu-thermal\n",
            "sys/class/thermal/thermal_zone1/temp": "51540\n",
            "sys/class/thermal/thermal_zone2/type": "battery\n",
            "sys/class/thermal/thermal_zone2/temp": "90000\n",
            "proc/stat": STAT.format(user=1000, idle=8000),
            "proc/self/statm": "30000 12000 5000 1 0 9000 0\n",
            "proc/meminfo": MEMINFO,
            FIRMWARE: "0\n",
        },
    )
    return tmp_path


def test_a_board_that_is_well_tells_all(zero_w: Path) -> None:
    board = Board(zero_w, disk=zero_w)
    first = board.read()
    assert first.cpu is None, "there is nothing yet to compare with"
    assert first.temperature_C == 51.54, "the processor's hottest zone, not the battery's"
    assert first.memory_MB == 12000 * resource.getpagesize() / 1e6
    assert first.memory_free_MB == 256.0
    assert first.throttled == []
    space = os.statvfs(zero_w)
    assert first.disk_free_MB is not None
    assert 0 < first.disk_free_MB <= space.f_blocks * space.f_frsize / 1e6

    write(zero_w, {"proc/stat": STAT.format(user=1075, idle=8025)})
    assert board.read().cpu == 0.75
    assert board.read().cpu is None, "no time has passed, nothing can be said"


def test_its_fields_are_the_health_messages() -> None:
    names = {field.name for field in dataclasses.fields(BoardState)}
    assert names <= {field.name for field in dataclasses.fields(messages.Health)}


def test_a_processor_that_did_nothing_or_all_stays_between_0_and_1(zero_w: Path) -> None:
    board = Board(zero_w)
    board.read()
    write(zero_w, {"proc/stat": STAT.format(user=1000, idle=8100)})
    assert board.read().cpu == 0.0
    write(zero_w, {"proc/stat": STAT.format(user=1200, idle=8090)})  # idle went back a little
    assert board.read().cpu == 1.0
    write(zero_w, {"proc/stat": STAT.format(user=10, idle=10)})  # began again
    assert board.read().cpu is None


@pytest.mark.parametrize(
    ("bits", "names"),
    [
        ("0", []),
        ("1", ["undervoltage"]),
        ("50005", ["undervoltage", "throttled", "undervoltage-was", "throttled-was"]),
        ("a0000", ["frequency-capped-was", "soft-temperature-limit-was"]),
        ("0x80008\n", ["soft-temperature-limit", "soft-temperature-limit-was"]),
        ("fff0fff0", []),  # bits that nobody has given a meaning
    ],
)
def test_the_firmwares_bits_have_names(zero_w: Path, bits: str, names: list[str]) -> None:
    write(zero_w, {FIRMWARE: bits})
    assert Board(zero_w).read().throttled == names


@pytest.mark.parametrize("text", ["", "nan", "-1", "throttled=0x0", "123456789", "0x", "\x00\xff"])
def test_a_firmware_that_says_nonsense_says_nothing(zero_w: Path, text: str) -> None:
    write(zero_w, {FIRMWARE: text})
    assert Board(zero_w).read().throttled is None


def test_a_kernel_without_the_firmwares_file_still_has_the_alarm(zero_w: Path) -> None:
    (zero_w / FIRMWARE).unlink()
    write(
        zero_w,
        {
            "sys/class/hwmon/hwmon0/name": "cpu_thermal\n",
            "sys/class/hwmon/hwmon1/name": "rpi_volt\n",
            "sys/class/hwmon/hwmon1/in0_lcrit_alarm": "1\n",
        },
    )
    board = Board(zero_w)
    assert board.read().throttled == ["undervoltage"]
    write(zero_w, {"sys/class/hwmon/hwmon1/in0_lcrit_alarm": "0\n"})
    assert board.read().throttled == []
    write(zero_w, {"sys/class/hwmon/hwmon1/in0_lcrit_alarm": "7\n"})
    assert board.read().throttled is None


def test_a_zone_that_fails_or_lies_is_left_out(zero_w: Path) -> None:
    board = Board(zero_w)
    write(zero_w, {"sys/class/thermal/thermal_zone1/temp": "999999\n"})
    assert board.read().temperature_C == 48.312
    write(zero_w, {"sys/class/thermal/thermal_zone0/temp": "nan\n"})
    assert board.read().temperature_C is None
    write(zero_w, {"sys/class/thermal/thermal_zone0/temp": "0\n"})
    assert board.read().temperature_C == 0.0, "cold, and told again after a time of silence"


def test_a_zone_whose_driver_is_loaded_anew_is_found_again(zero_w: Path) -> None:
    board = Board(zero_w)
    assert board.read().temperature_C == 51.54
    thermal = zero_w / "sys/class/thermal"
    (thermal / "thermal_zone0/temp").unlink()
    (thermal / "thermal_zone1").rename(thermal / "thermal_zone4")
    assert board.read().temperature_C is None
    assert board.read().temperature_C == 51.54


def test_an_empty_tree_and_a_disk_that_is_not_there_are_none(tmp_path: Path) -> None:
    assert Board(tmp_path, disk=tmp_path / "absent").read() == BoardState()
    assert Board(tmp_path / "absent").read() == BoardState()


def test_a_fifo_in_the_place_of_a_file_is_not_waited_for(zero_w: Path) -> None:
    (zero_w / "proc/meminfo").unlink()
    os.mkfifo(zero_w / "proc/meminfo")
    (zero_w / FIRMWARE).unlink()
    (zero_w / FIRMWARE).mkdir()
    state = Board(zero_w).read()
    assert state.memory_free_MB is None and state.throttled is None
    assert state.temperature_C == 51.54


def test_this_machine_is_read() -> None:
    state = Board(disk=Path("/")).read()
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6
    # The kernel keeps both counts a little apart, on each processor.
    assert state.memory_MB is not None and 1 < state.memory_MB < 1.1 * peak_mb + 10
    assert state.memory_free_MB is not None and state.memory_free_MB > 1
