"""What comes from elsewhere is shown on one line, in the errors of every room as well."""

from __future__ import annotations

import pytest

from deploy.errors import DeployError
from ground_station.errors import GroundStationError
from hw.quantities import HardwareError
from pi_firmware.wire.errors import BlimpError
from pi_firmware.wire.text import printable

HOSTILE = "\x1b[2Jmap\n\u202egnp.txt\r\0 é 地図\udcff"


def test_what_could_steer_a_terminal_is_shown_as_a_question_mark() -> None:
    assert printable(HOSTILE) == "?[2Jmap??gnp.txt?? é 地図?"
    assert printable(HOSTILE, 7, " ") == " [2Jmap"


@pytest.mark.parametrize("of", [BlimpError, GroundStationError, HardwareError, DeployError])
def test_an_errors_text_is_one_line_whatever_it_names(of: type[Exception]) -> None:
    assert str(of(f"{HOSTILE}: not a map")) == f"{printable(HOSTILE)}: not a map"
    assert str(of()) == ""


def test_a_name_of_a_megabyte_is_not_printed() -> None:
    assert len(str(BlimpError("x" * 1_000_000))) == 2000
