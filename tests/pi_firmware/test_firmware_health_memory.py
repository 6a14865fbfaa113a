"""What CPython keeps of freed objects goes again, and quickly."""

import gc
import subprocess
import sys
import threading
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, cast

import pytest

from pi_firmware import supervision
from pi_firmware.health import memory

PROGRAM = """
import gc, sys
from pi_firmware import __main__, payload

class Told(payload.Payload):
    def run(self, stop):
        print("frozen", gc.get_freeze_count(), "of", len(gc.get_objects()))

payload.Payload = Told
sys.argv = ["pi_firmware", "--set", "camera.uri=test:", "--set", "telemetry.enabled=false",
            "--set", "link.host=127.0.0.1"]
sys.exit(__main__.main())
"""


def cut(length: int) -> tuple[int, ...]:
    """A tuple that was made longer than it is."""
    return tuple(number for number in range(length))


@pytest.fixture
def no_collections() -> Iterator[None]:
    gc.collect()
    gc.disable()
    yield
    gc.enable()


def test_freed_tuples_are_put_by_until_they_are_collected(no_collections: None) -> None:
    before = sys.getallocatedblocks()
    for _ in range(1500):
        cut(3)
    grown = sys.getallocatedblocks() - before
    assert grown > 1000, "this interpreter keeps no freed tuples, and needs no collecting"
    memory.collect()
    assert sys.getallocatedblocks() - before < 100


def test_it_is_a_task_of_every_flight() -> None:
    from pi_firmware.settings import Settings

    (task,) = [task for task in supervision.tasks(Settings()) if task.name == supervision.MEMORY]
    assert task.period_s <= 60


def test_a_flight_does_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Named in the table is not yet done: only a thread that runs it empties the lists."""
    from pi_firmware.settings import Settings

    collected = threading.Event()
    monkeypatch.setattr(memory, "collect", collected.set)
    watching = supervision.Supervision(Settings(), lambda name, text: None)
    monkeypatch.setattr(watching, "health", lambda *_: None)
    silent = SimpleNamespace(health=lambda _: None, ask_time=lambda: None, refusals=list)
    nothing: Any = SimpleNamespace(seen=None, armed=False)
    try:
        watching.start(nothing, nothing, nothing, cast(Any, silent), nothing)
        assert collected.wait(20)
        assert supervision.MEMORY in watching.table.ages()
    finally:
        watching.stop()


def test_the_program_freezes_what_it_loaded_before_it_flies() -> None:
    ran = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=60, check=False
    )
    assert (ran.returncode, ran.stderr) == (0, "")
    frozen = int(ran.stdout.partition("frozen ")[2].split()[0])
    rest = int(ran.stdout.partition(" of ")[2].split()[0])
    assert frozen > 10_000 and rest < frozen / 5
