"""Memory that is free inside a process goes back to the system."""

import subprocess
import sys
from pathlib import Path

import pytest
from intake_stand import free_udp_port

from ground_station.service.intake import process
from ground_station.service.intake.process import Intake
from ground_station.service.settings import StationSettings
from pi_firmware.wire.config import from_mapping

HOLES = """
from pathlib import Path
from ground_station.service.intake import process

def resident():
    return int(Path("/proc/self/statm").read_text().split()[1])

blocks = [bytes(50_000) for _ in range(2000)]
full = resident()
kept = blocks[-1]  # the heap cannot shrink past it
del blocks
holes = resident()
process.give_back()
print(full, holes, resident())
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_holes_in_the_heap_are_given_back() -> None:
    done = subprocess.run(
        [sys.executable, "-c", HOLES], capture_output=True, text=True, check=True, timeout=120
    )
    full, holes, after = map(int, done.stdout.split())
    pages = 2000 * 50_000 // 4096
    assert full - holes < 0.1 * pages  # they are held, or there is nothing to give back
    assert holes - after > 0.9 * pages


def test_the_intake_gives_back_what_a_payload_left_when_it_goes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[str] = []
    monkeypatch.setattr(process, "give_back", lambda: given.append("back"))
    said: list[str] = []
    document = {
        "video": {"port": free_udp_port()},
        "telemetry": {"listen": ["tcp/127.0.0.1:0"]},
        "recording": {"folder": str(tmp_path), "min_free_MB": 0},
    }
    settings = from_mapping(document, StationSettings)
    with Intake(settings, lambda _, who, note: said.append(getattr(note, "name", ""))) as intake:
        payload = intake._roster.take_up("blimp-1")
        assert payload is not None
        intake._follow()
        assert given == []  # nobody was here
        payload.alive = True  # as it was until now; nothing of it comes any more
        intake._follow()
        intake._follow()
    assert "payload-gone" in said and given == ["back"]
