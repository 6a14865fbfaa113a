"""Restarts of process and board, counted in a file that may be cut, old or hostile."""

import json
import random
import threading
from pathlib import Path

import pytest
from waiting import eventually

from pi_firmware.health.restarts import Restarts
from pi_firmware.wire import files


class Card:
    """A board whose processes come and go, with the file on its card."""

    def __init__(self, folder: Path) -> None:
        self.root = folder / "root"
        self.path = folder / "restarts.json"
        self.boots = 0
        self.boot()

    def boot(self) -> None:
        self.boots += 1
        path = self.root / "proc/sys/kernel/random/boot_id"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{self.boots:08x}-0000-4000-8000-000000000000\n")

    def process(self, limit: int = 3) -> Restarts:
        restarts = Restarts(str(self.path), limit, root=self.root)
        restarts.begin()
        return restarts

    @property
    def document(self) -> dict[str, object]:
        return json.loads(self.path.read_text())


@pytest.fixture
def card(tmp_path: Path) -> Card:
    return Card(tmp_path)


def sends_a_frame(card: Card, process: Restarts) -> None:
    process.fresh()
    eventually(lambda: card.document["without_frame"] == 0)


def test_processes_of_one_boot_are_counted(card: Card) -> None:
    assert [card.process().process_restarts for _ in range(4)] == [0, 1, 2, 3]
    card.boot()
    process = card.process()
    assert process.process_restarts == 0
    process.begin()
    assert process.process_restarts == 0, "it has begun once"
    assert process.board_restarts == 0, "somebody switched it off and on; we did not ask"


def test_three_processes_without_a_frame_allow_a_reboot_and_it_is_counted(card: Card) -> None:
    for _ in range(2):
        assert not card.process().claim_reboot(ending=True)
    third = card.process()
    assert not third.claim_reboot(ending=False), "the third shall have its try"
    assert third.claim_reboot(ending=True)
    assert not third.claim_reboot(ending=True), "once"
    card.boot()
    after = card.process()
    assert after.board_restarts == 1 and after.process_restarts == 0
    assert not after.claim_reboot(ending=False), "a new boot gets its three tries, too"


def test_processes_that_were_killed_before_they_could_ask_count_at_the_next_start(
    card: Card,
) -> None:
    for _ in range(3):
        card.process()
    assert card.process().claim_reboot(ending=False)


def test_a_frame_ends_the_row(card: Card) -> None:
    for _ in range(2):
        card.process()
    third = card.process()
    sends_a_frame(card, third)
    assert not third.claim_reboot(ending=True)
    for _ in range(2):
        assert not card.process().claim_reboot(ending=True)
    assert card.process().claim_reboot(ending=True)


def test_after_three_reboots_in_vain_the_board_stays_up_until_a_frame_came(card: Card) -> None:
    reboots = 0
    for _ in range(60):
        process = card.process()
        if process.claim_reboot(ending=True):
            reboots += 1
            card.boot()
    assert reboots == 3 and process.board_restarts == 3
    card.boot()  # switched off and on by hand: still in vain
    for _ in range(10):
        assert not card.process().claim_reboot(ending=True)
    sends_a_frame(card, card.process())
    assert card.document["reboots_in_a_row"] == 0
    claims = [card.process().claim_reboot(ending=True) for _ in range(3)]
    assert claims == [False, False, True]
    assert process.board_restarts == 3


def test_a_reboot_that_did_not_happen_is_not_counted_as_one(card: Card) -> None:
    claims = [card.process().claim_reboot(ending=True) for _ in range(12)]
    assert claims.count(True) == 3, "each was allowed, and the third was the last"
    card.boot()
    assert card.process().board_restarts == 0


def test_a_power_cut_is_not_a_row_of_failures(card: Card) -> None:
    for _ in range(20):
        process = card.process()
        assert not process.claim_reboot(ending=False)
        card.boot()


def test_the_first_frame_only_is_written(card: Card) -> None:
    process = card.process()
    sends_a_frame(card, process)
    written = card.path.stat()
    for _ in range(1000):
        process.fresh()
    eventually(lambda: "restarts" not in {thread.name for thread in threading.enumerate()})
    after = card.path.stat()
    assert (after.st_ino, after.st_mtime_ns) == (written.st_ino, written.st_mtime_ns)
    assert not card.path.with_name("restarts.json.part").exists()


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"null",
        b"[]",
        b"{}",
        b"\xff\xfe\x00",
        b"[" * 4000,
        b'{"schema": "blimp.restarts/2", "processes": 5}',
        b"9" * 4000,
    ],
)
def test_nonsense_in_the_file_is_zero(card: Card, content: bytes) -> None:
    card.path.write_bytes(content)
    process = card.process()
    assert (process.process_restarts, process.board_restarts) == (0, 0)
    assert not process.claim_reboot(ending=True)
    assert card.document["processes"] == 1, "and repaired"


@pytest.mark.parametrize("value", [-1, 10**12, 2.0, True, None, "3", [], float("nan")])
@pytest.mark.parametrize("name", ["processes", "without_frame", "reboots", "reboots_in_a_row"])
def test_a_number_that_cannot_be_makes_the_file_nonsense(
    card: Card, name: str, value: object
) -> None:
    for _ in range(3):
        card.process()
    card.path.write_text(json.dumps({**card.document, name: value}))
    process = card.process()
    assert process.process_restarts == 0
    assert not process.claim_reboot(ending=True)


@pytest.mark.parametrize("seed", range(5))
def test_a_file_cut_or_bent_anywhere_raises_nothing_and_bounds_the_reboots(
    card: Card, seed: int
) -> None:
    chance = random.Random(seed)
    card.process()
    good = card.path.read_bytes()
    for _ in range(60):
        bent = bytearray(good[: chance.randrange(len(good) + 1)])
        for _ in range(chance.randrange(3)):
            if bent:
                bent[chance.randrange(len(bent))] = chance.randrange(256)
        card.path.write_bytes(bent)
        process = card.process()
        process.claim_reboot(ending=True)
        assert 0 <= process.process_restarts <= 10**9
        assert json.loads(card.path.read_text())["schema"] == "blimp.restarts/1"


def test_without_a_file_nothing_is_counted_and_nothing_rebooted(tmp_path: Path) -> None:
    for _ in range(5):
        process = Restarts("", 1)
        process.begin()
        process.fresh()
        assert not process.claim_reboot(ending=True)
        assert (process.process_restarts, process.board_restarts) == (0, 0)


def test_a_reboot_that_cannot_be_counted_is_not_allowed(
    card: Card, capsys: pytest.CaptureFixture[str]
) -> None:
    for _ in range(2):
        card.process()
    third = card.process()
    card.path.unlink()
    card.path.mkdir()  # nothing can be renamed onto it, whoever runs this
    assert not third.claim_reboot(ending=True)
    assert not third.claim_reboot(ending=True)
    complaint = capsys.readouterr().err
    assert complaint.count("supervision.state") == 1 and complaint.count("\n") == 1
    card.path.rmdir()
    assert third.claim_reboot(ending=True), "it had not been used up"


def test_a_folder_that_is_not_there_stops_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    process = Restarts(str(tmp_path / "absent" / "restarts.json"), 1)
    process.begin()
    assert process.process_restarts == 0
    assert not process.claim_reboot(ending=True)
    assert "supervision.state" in capsys.readouterr().err


def test_a_board_without_a_boot_id_counts_all_the_same(card: Card) -> None:
    (card.root / "proc/sys/kernel/random/boot_id").unlink()
    assert [card.process().claim_reboot(ending=True) for _ in range(3)] == [False, False, True]


def test_the_file_is_replaced_as_a_power_cut_needs_it(
    card: Card, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[Path] = []
    monkeypatch.setattr(files, "write", lambda path, data: written.append(path))
    card.process()
    assert written == [card.path]
