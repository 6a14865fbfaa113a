"""`pi_firmware.health`: the kernel's files as a board may show them, and what `iw` prints."""

from __future__ import annotations

import contextlib
import math

from pieces import Picker, blocks, scratch

from pi_firmware.health import radio
from pi_firmware.health.board import Board
from pi_firmware.health.radio import ProgramError

_ROOT = scratch("board")
_FILES = {
    "proc/stat": b"cpu  1 2 3 4 5 6 7 8 9 10\n",
    "proc/meminfo": b"MemTotal:  500000 kB\nMemAvailable:  300000 kB\n",
    "proc/self/statm": b"1000 500 100 1 0 1 0\n",
    "proc/net/wireless": b"Inter-|\n wlan0: 0000   54.  -56.  -256        0\n",
    "sys/class/thermal/thermal_zone0/type": b"cpu-thermal\n",
    "sys/class/thermal/thermal_zone0/temp": b"51000\n",
    "sys/devices/platform/soc/soc:firmware/get_throttled": b"50005\n",
    "sys/class/hwmon/hwmon0/name": b"rpi_volt\n",
    "sys/class/hwmon/hwmon0/in0_lcrit_alarm": b"1\n",
    "sys/class/net/wlan0/flags": b"0x1003\n",
    "sys/class/net/wlan0/ifindex": b"3\n",
}
for _name in _FILES:
    (_ROOT / _name).parent.mkdir(parents=True, exist_ok=True)
(_ROOT / "sys/class/net/wlan0/wireless").mkdir()


def fuzz(data: bytes) -> None:
    """Nothing raises, and no number is one that cannot be."""
    picker = Picker(data)
    for name, whole in _FILES.items():
        how = picker.number(1)
        (_ROOT / name).write_bytes(picker.block() if how & 1 else whole)
    board = Board(_ROOT, _ROOT)
    board.read()
    (_ROOT / "proc/stat").write_bytes(picker.block())
    state = board.read()
    assert state.cpu is None or 0 <= state.cpu <= 1
    assert state.temperature_C is None or -60 <= state.temperature_C <= 150
    radio.find(_ROOT, radio.AUTO)
    radio.is_down(_ROOT, "wlan0")
    radio.index(_ROOT, "wlan0")
    said = picker.block().decode(errors="replace")
    for signal in (
        radio.signal_dbm(_ROOT, "wlan0"),
        radio.asked_signal_dbm(lambda _: said, "wlan0"),
    ):
        assert signal is None or (math.isfinite(signal) and 0 <= radio.quality(signal) <= 1)
    with contextlib.suppress(ProgramError):
        radio.set_power_save_off(lambda _: said, "wlan0")


def seeds() -> list[bytes]:
    """A board that is well; each file as another."""
    link = b"Connected to 00:11\n\tsignal: -61 dBm\n"
    well = bytes(len(_FILES)) + blocks(b"cpu  2 3 4 5 6 7 8 9 9 10\n", link)
    odd = b"".join(b"\1" + blocks(text + b"9" * 20) for text in _FILES.values())
    return [well, odd, bytes(len(_FILES)) + blocks(b"", b"Power save: off")]
