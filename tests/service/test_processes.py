"""Processes that end, hang or refuse are restarted or end the service; nobody is left behind."""

from __future__ import annotations

import dataclasses
import os
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import numpy as np
import pytest
from waiting import eventually

from ground_station.service import bus_messages, processes, settings
from ground_station.service.bus import Bus
from ground_station.service.bus_messages import EventMessage, PayloadMessage
from ground_station.service.pictures import SLOTS, PictureReader, PictureWriter, path_of
from ground_station.service.processes import Child, Children, ServiceError, Spec
from pi_firmware.wire.errors import BlimpError, ConfigError

LIMIT_S = 20.0

MODULES = {
    "stays": "import time\nwhile True: time.sleep(0.1)\n",
    "ends": "import sys\nsys.exit(1)\n",
    "refuses": "import sys\nprint('stand-in: no such port', file=sys.stderr)\nsys.exit(2)\n",
}


@pytest.fixture
def modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name, text in MODULES.items():
        (tmp_path / f"stand_in_{name}.py").write_text(text)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return tmp_path


class Time:
    """A clock that is set by hand."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


def test_a_process_that_ends_is_started_anew_after_ever_longer_pauses(modules: Path) -> None:
    clock = Time()
    child = Child(Spec("ends", "stand_in_ends"), clock)
    pauses = []
    for _ in range(7):
        before_s = clock.now_s
        child.step()
        while child.pid is None:
            clock.now_s += 0.25
            child.step()
        pauses.append(clock.now_s - before_s)
        said: list[str] = []
        eventually(lambda s=said: any(s), step=lambda s=said: s.append(child.step()))  # type: ignore[misc]
        assert said[-1] == "ends ended with status 1; it is restarted"
    assert child.restarts == 7
    assert pauses == sorted(pauses) and 9 < pauses[-1] <= 10.5


def test_a_process_that_falls_silent_is_killed_and_started_anew(modules: Path) -> None:
    clock = Time()
    child = Child(Spec("stays", "stand_in_stays"), clock)
    child.step()
    first = child.pid
    assert first is not None and not child.living
    child.heartbeat(first + 1)  # of one that is long gone
    assert not child.living
    child.heartbeat(first)
    assert child.living
    clock.now_s += 9.9
    assert child.step() == "" and child.living
    clock.now_s += 0.2
    assert "was silent for 10 s" in child.step()
    with pytest.raises(ProcessLookupError):
        os.kill(first, 0)
    clock.now_s += 0.6
    child.step()
    assert child.pid not in (None, first)
    assert child.hopeful
    clock.now_s += 60
    assert not child.hopeful  # a minute's restarts did not help
    child.terminate()
    child.wait(clock() + LIMIT_S)


def test_a_computer_that_slept_restarts_nobody_who_was_well(modules: Path) -> None:
    clock, said = Time(), list[str]()
    children = Children((Spec("stays", "stand_in_stays"),), said.append, clock)
    children.step()
    pid = children.pids()["stays"]
    children.heartbeat("stays", pid)
    clock.now_s += 1000.0
    children.step()
    assert children.pids() == {"stays": pid} and said == []
    assert children.living()  # nor does the watchdog hear of it
    for _ in range(11):  # one that is silent from then on is
        clock.now_s += 1.0
        children.step()
    assert said == ["stays was silent for 11 s; it is restarted"]
    children.close()


def test_who_ends_slowly_is_not_waited_for(modules: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, "_TERM_S", 1.0)
    spec = Spec("stays", "stand_in_stays")
    children = Children((spec,), lambda text: None)
    children.step()
    pid = children.pids()["stays"]
    os.kill(pid, signal.SIGSTOP)  # it hears no request to end
    eventually(lambda: _state(pid) == "T")
    children.remove("stays")
    assert _runs(pid) and "stays" not in children
    children.add(spec)
    assert "stays" not in children  # not beside the one that ends
    eventually(lambda: not _runs(pid), step=children.step)
    eventually(lambda: "stays" in children, step=lambda: (children.step(), children.add(spec)))
    children.close()


def test_who_cannot_be_killed_holds_nobody_up(monkeypatch: pytest.MonkeyPatch) -> None:
    class Undying(subprocess.Popen[bytes]):
        def __init__(self, *_: object, **__: object) -> None:
            self.pid, self.returncode = 1, None

        def poll(self) -> int | None:
            return None

        def wait(self, timeout: float | None = None) -> int:
            assert timeout is not None
            raise subprocess.TimeoutExpired("undying", timeout)

        def send_signal(self, sig: int) -> None:
            pass

        def __del__(self) -> None:
            pass

    monkeypatch.setattr(subprocess, "Popen", Undying)
    clock = Time()
    child = Child(Spec("stays", "stand_in_stays"), clock)
    child.step()
    clock.now_s += 61.0
    assert "was silent for 61 s" in child.step()


def test_bad_input_of_a_needed_process_ends_the_service(modules: Path) -> None:
    children = Children((Spec("refuses", "stand_in_refuses"),), lambda text: None)

    def step() -> bool:
        try:
            children.step()
        except ServiceError as error:
            assert str(error) == "refuses cannot start"
            return True
        return False

    eventually(step)
    one_may = Child(Spec("refuses", "stand_in_refuses", needed=False))
    said: list[str] = []
    eventually(lambda: bool(said and said[-1]), step=lambda: said.append(one_may.step()))
    assert "status 2" in said[-1]


def test_a_later_process_waits_for_the_needed_ones_at_the_first_start_only(modules: Path) -> None:
    needed = Spec("stays", "stand_in_stays")
    later = Spec("ends", "stand_in_ends", needed=False, later=True)
    children = Children((later, needed), lambda text: None)
    waiting, awaited = (children._children[name] for name in ("ends", "stays"))
    try:
        for _ in range(20):
            children.step()
        assert awaited.pid is not None and not waiting.started
        awaited.heartbeat(awaited.pid)
        children.step()
        assert waiting.started
        os.kill(awaited.pid, signal.SIGKILL)  # from here on none waits for the other
        eventually(lambda: waiting.restarts >= 2 and awaited.restarts == 1, step=children.step)
    finally:
        children.close()


def test_children_end_with_a_parent_that_is_killed(modules: Path, tmp_path: Path) -> None:
    parent = (
        "import sys, time\n"
        "from ground_station.service.processes import Child, Spec\n"
        "child = Child(Spec('stays', 'stand_in_stays'))\n"
        "child.step()\n"
        "print(child.pid, flush=True)\n"
        "time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", parent], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        pid = int(process.stdout.readline())
        time.sleep(0.3)  # setpriv gives way to the program
        process.send_signal(signal.SIGKILL)
    eventually(lambda: not _runs(pid))


def _runs(pid: int) -> bool:
    return _state(pid) not in ("", "Z")


def _state(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return ""


def test_notes_cross_the_bus_and_what_is_none_is_dropped(bus_folder: Path) -> None:
    with Bus(bus_folder, "one") as one, Bus(bus_folder, "two") as two:
        heard: list[tuple[str, EventMessage]] = []
        two.subscribe(
            bus_messages.EVENT, EventMessage, lambda payload, note: heard.append((payload, note))
        )
        newest = two.newest(bus_messages.PAYLOAD, PayloadMessage, "blimp-1")
        event = EventMessage(1, "station", bus_messages.INFO, "hello", "zwölf °")
        eventually(
            lambda: bool(heard), step=lambda: one.publish(bus_messages.EVENT, "blimp-1", event)
        )
        assert heard[0] == ("blimp-1", event)
        one._session.put("station/event/x", b'{"time_ns": 1}')
        one._session.put("station/event/x", b"\xff")
        eventually(lambda: two.dropped == 2)
        one.publish(bus_messages.PAYLOAD, "blimp-2", PayloadMessage(True, 1))
        for seen_ns in range(1, 6):
            one.publish(bus_messages.PAYLOAD, "blimp-1", PayloadMessage(True, seen_ns))
        eventually(lambda: newest.skipped == 4)
        note = newest.take(LIMIT_S)
        assert note is not None and note.seen_ns == 5
        assert newest.take(0.01) is None


def test_questions_are_answered_refused_or_not_answered(bus_folder: Path) -> None:
    class Refusal(BlimpError):
        pass

    def do(request: object) -> dict[str, object]:
        if request == {"do": "refuse"}:
            raise Refusal("not now")
        if request == {"do": "break"}:
            raise KeyError("inside")
        return {"asked": request}

    with Bus(bus_folder, "one") as one, Bus(bus_folder, "two") as two:
        one.serve("intake", do)
        eventually(lambda: two.query("intake", {"do": "x"})["done"] is True)
        assert two.query("intake", {"do": "x"}) == {
            "done": True,
            "reason": "",
            "asked": {"do": "x"},
        }
        assert two.query("intake", {"do": "refuse"}) == {"done": False, "reason": "not now"}
        assert two.query("intake", {"do": "break"})["reason"] == "KeyError: 'inside'"
        nobody = two.query("nobody", {}, timeout_s=0.5)
        assert nobody == {"done": False, "reason": "the service's nobody did not answer"}


def test_a_picture_is_read_whole_or_not_at_all(tmp_path: Path) -> None:
    writer, reader = PictureWriter(tmp_path, "b"), PictureReader(tmp_path, "b")
    assert reader.read(0, 2) is None
    images = [np.full((48, 64), n, np.uint8) for n in range(SLOTS + 1)]
    written = [writer.write(image) for image in images]
    for image, (slot, stamp) in list(zip(images, written, strict=True))[1:]:
        read = reader.read(slot, stamp)
        assert read is not None and np.array_equal(read, image)
    assert reader.read(*written[0]) is None  # overwritten
    assert reader.read(99, 2) is None and reader.read(-1, 2) is None
    slot, stamp = writer.write(np.full((32, 96), 7, np.uint8))  # another camera mode
    again = reader.read(slot, stamp)
    assert again is not None and again.shape == (32, 96) and (again == 7).all()
    assert path_of(tmp_path, "b").stat().st_mode & 0o077 == 0
    writer.close()
    assert reader.read(slot, stamp) is None
    path_of(tmp_path, "b").write_bytes(b"nonsense" * 100)
    assert reader.read(slot, stamp) is None


def test_the_shipped_file_documents_every_key() -> None:
    text = settings.SHIPPED.read_text()
    assert tomllib.loads(text) == dataclasses.asdict(settings.StationSettings())
    assert settings.load(settings.SHIPPED) == settings.StationSettings()
    for line in text.splitlines():
        assert len(line) <= 100


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("http.port=70000", "'http.port' is 70000; allowed: 0 to 65535"),
        ("foxglove.host=0.0.0.0", "'foxglove.host' is '0.0.0.0'; only loopback"),
        ("telemetry.listen=['tcp/10.0.0.1:7447']", "only loopback is allowed"),
        ("payloads.ids=['a b']", "the name 'a b'"),
        ("name=.", "the name '.'"),
        ("colour=1", "unknown key 'colour'"),
        ("http", "expected key=value"),
    ],
)
def test_wrong_settings_are_refused_by_name(override: str, named: str) -> None:
    with pytest.raises(ConfigError) as refusal:
        settings.load(None, [override])
    assert named in str(refusal.value) and "\n" not in str(refusal.value)


def test_a_run_is_read_as_it_was_written(tmp_path: Path) -> None:
    run = settings.Run(settings.load(None, ["http.port=0"]), demo=True, started_ns=5)
    settings.write_run(tmp_path, run)
    assert settings.load_run(tmp_path) == run
    (tmp_path / settings.RUN_FILE).write_text("{")
    with pytest.raises(ConfigError):
        settings.load_run(tmp_path)
