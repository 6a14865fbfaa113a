"""The payload's real firmware behind start.py: an update that works stays, one that does not goes
back by itself, and telemetry says why."""

import json
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from card_stand import CHECKOUT, MADE, NEW, NOW, Card, lay, release_json
from manager import Manager
from receiving import Receiver

from deploy.board.releases import watch
from deploy.update import bundle as bundles
from ground_station.stream.feedback import Feedback
from ground_station.stream.telemetry import PayloadState, TelemetryListener
from pi_firmware import __version__

LIMIT_S = 60.0
HANGS = b"import time\ntime.sleep(600)\n"
CRASHES = b"import sys\nprint('no camera', file=sys.stderr)\nsys.exit(1)\n"


def firmware(version: str, made: str, **files: bytes) -> dict[str, bytes]:
    """The checkout's own firmware as a release of another version."""
    found = bundles.release_of(CHECKOUT, None, "aarch64", "3.13")
    found["release.json"] = release_json(version, made=made)
    return found | {f"pi_firmware/{name}.py": data for name, data in files.items()}


def said_of(release: str) -> str:
    """What this checkout's firmware says in a release of that name."""
    return release if release.startswith(f"{__version__}+") else f"{__version__} in {release}"


class Flight:
    """A card that flies, and a ground station that hears it."""

    def __init__(self, stack: ExitStack, card: Card, tmp_path: Path) -> None:
        self.card = card
        lay(card.at.factory, firmware(NOW, MADE[NOW]))
        receiver = stack.enter_context(Receiver(port=0))
        self.listener = stack.enter_context(TelemetryListener(["tcp/127.0.0.1:0"]))
        stack.enter_context(Feedback(self.listener, lambda payload_id: receiver))
        card.at.config.write_text(
            f'payload_id = "blimp-1"\n[camera]\nuri = "test:"\nrate_hz = 10\n'
            f"[link]\nport = {receiver.port}\n"
            f"[telemetry]\nconnect = {json.dumps(list(self.listener.endpoints))}\n"
        )
        command = [sys.executable, "-m", "deploy.board.start", "--root", str(card.root)]
        variables = {**os.environ, "PYTHONPATH": str(CHECKOUT)}
        self.manager = Manager(command, variables, tmp_path)
        card.service = self.manager  # type: ignore[assignment]
        stack.enter_context(self.manager)

    def update(self, files: dict[str, bytes]) -> list[str]:
        """Sends a release and waits for the watcher's word."""
        self.card.take(self.card.bundle(files))
        said: list[str] = []
        watching = threading.Thread(
            target=watch.watch,
            args=(self.card.at, self.manager, said.append),
            daemon=True,
        )
        watching.start()
        watching.join(watch.LIMIT_S + LIMIT_S)
        assert not watching.is_alive()
        return said

    def heard(self, version: str, how: str) -> PayloadState:
        def told(state: PayloadState) -> bool:
            health = state.health
            return health is not None and (health.version, health.release) == (version, how)

        state = self.listener.wait("blimp-1", told, LIMIT_S)
        assert state is not None
        return state


@pytest.fixture
def flight(card: Card, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Flight]:
    monkeypatch.setattr(watch, "STEADY_S", 2.0)
    with ExitStack() as stack:
        yield Flight(stack, card, tmp_path)


def test_updates_of_a_payload_in_flight(flight: Flight, monkeypatch: pytest.MonkeyPatch) -> None:
    first = flight.heard(said_of(NOW), "factory")
    assert first.health is not None and first.health.release_reason == ""
    wait = threading.Event()
    for _ in range(100):  # so that telemetry must be up afterwards, too
        if flight.manager.seen().telemetry:
            break
        wait.wait(0.1)
    assert flight.manager.seen().telemetry

    # A release that does not even start: back on the one before, at once, and told to the ground.
    said = flight.update(firmware(NEW, MADE[NEW], __main__=CRASHES))
    # Which of both is seen first depends on how busy the machine is.
    why = "the firmware ended by itself" if "itself" in said[-1] else "started 3 times"
    assert said[-1].startswith(f"{NEW}: fell back: {NEW}: {why}")
    back = flight.heard(said_of(NOW), "fell back")
    assert back.health is not None
    assert back.health.release_reason.startswith(f"{NEW}: {why}")
    started = next(event for event in back.events if event.name == "started")
    assert f"{NEW}: {why}" in started.text

    # One that runs and never gives a frame: back when its time is over.
    with monkeypatch.context() as patch:
        patch.setattr(watch, "LIMIT_S", 2.0)
        flight.update(firmware("0.3.0", MADE[NEW], __main__=HANGS))
    reason = "0.3.0: no frames within 2 s (activating)"
    assert json.loads(flight.card.at.last.read_text())["reason"] == reason
    again = flight.listener.wait(
        "blimp-1", lambda s: s.health is not None and s.health.release_reason == reason, LIMIT_S
    )
    assert again is not None

    # One that works stays, and nothing is said of the old fault any more.
    newest = "0.9.0+gitworks"
    said = flight.update(firmware(newest, MADE[NEW]))
    assert said[-1] == f"{newest}: healthy"
    well = flight.heard(f"{__version__} in {newest}", "update")
    assert well.health is not None and well.health.release_reason == ""
    assert flight.card.names() == {newest, "current"}
