"""A rotation of the authority while payload and ground station fly: they are heard throughout."""

import shutil
import time
from pathlib import Path

from ground_station.keys.authority import STEPS, Authority
from ground_station.stream.telemetry import TelemetryListener
from pi_firmware.settings import TelemetrySettings
from pi_firmware.telemetry import Telemetry
from pi_firmware.wire import messages

LIMIT_S = 40.0
FREE = "tls/127.0.0.1:0"


class Machine:
    """A machine that holds the folder copied to it last."""

    def __init__(self, authority: Authority, name: str, folder: Path) -> None:
        self._authority, self._name = authority, name
        self.folder = folder

    def copy(self) -> None:
        """Copies the folder from the authority, as a person would."""
        shutil.copytree(self._authority.of(self._name), self.folder, dirs_exist_ok=True)


def start_ground(machine: Machine, endpoint: str) -> TelemetryListener:
    return TelemetryListener([endpoint], certificates=machine.folder)


def start_payload(machine: Machine, endpoint: str) -> Telemetry:
    settings = TelemetrySettings(connect=[endpoint], certificates=str(machine.folder))
    return Telemetry("blimp-1", settings)


def is_heard(listener: TelemetryListener, telemetry: Telemetry, voltage: float) -> bool:
    """Whether something that is said now arrives; it is said again until then."""
    deadline = time.monotonic() + LIMIT_S
    while time.monotonic() < deadline:
        telemetry.publish(messages.Battery(time_ns=1, voltage=voltage))
        if listener.wait(
            "blimp-1", lambda s: s.battery is not None and s.battery.voltage == voltage, 0.1
        ):
            return True
    return False


def test_payload_and_ground_speak_at_each_step_of_a_rotation(
    authority: Authority, tmp_path: Path
) -> None:
    """At each step one is restarted with its new folder, then the other, in either order."""
    at_ground = Machine(authority, "ground.main", tmp_path / "at ground")
    at_payload = Machine(authority, "payload.blimp-1", tmp_path / "at payload")
    at_ground.copy()
    at_payload.copy()
    stolen = shutil.copytree(at_payload.folder, tmp_path / "stolen before")
    ground = start_ground(at_ground, FREE)
    endpoint = ground.endpoints[0]
    payload = start_payload(at_payload, endpoint)
    voltage = 3.0
    assert is_heard(ground, payload, voltage)
    for number, step in enumerate([*STEPS[1:], STEPS[0]]):
        assert authority.rotate() == step
        for restarted in ("payload", "ground") if number % 2 else ("ground", "payload"):
            if restarted == "payload":
                payload.close()
                at_payload.copy()
                payload = start_payload(at_payload, endpoint)
            else:
                ground.close()
                at_ground.copy()
                ground = start_ground(at_ground, endpoint)
            voltage += 0.1
            assert is_heard(ground, payload, voltage), (step, restarted)
    payload.close()
    ground.close()
    # What was signed before the rotation opens nothing any more.
    with TelemetryListener([FREE], certificates=at_ground.folder) as listener:
        late = Telemetry(
            "blimp-1",
            TelemetrySettings(connect=list(listener.endpoints), certificates=str(stolen)),
        )
        assert listener.wait("blimp-1", lambda s: s.alive, 3.0) is None
        late.close()
