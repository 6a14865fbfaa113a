"""A new release stays when frames come and keep coming; otherwise the card goes back, with why."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from card_stand import NEW, Card, contents
from power import PowerCut, cut_after

from deploy.board.releases import choose, service, shelf, watch
from deploy.board.releases.choose import FELL_BACK, HEALTHY, Choice
from deploy.board.releases.service import Seen
from deploy.board.releases.watch import LIMIT_S, STEADY_S

END_S = LIMIT_S + STEADY_S
TRIAL = {"id": "t", "release": NEW, "previous": "", "telemetry": False}
HEARD = TRIAL | {"telemetry": True}
ON = {"trial": "t", "name": NEW, "reason": ""}
WELL = Seen(active=True, active_s=STEADY_S, restarts=0, telemetry=False, said="active")
STARTING = Seen(said="activating")


@pytest.mark.parametrize(
    ("trial", "running", "seen", "elapsed_s", "outcome", "reason"),
    [
        (TRIAL, ON, WELL, 20, HEALTHY, ""),
        (TRIAL, ON, WELL, LIMIT_S + 9, HEALTHY, ""),
        (TRIAL, ON, WELL._replace(active_s=STEADY_S - 1), 20, "", ""),
        (TRIAL, ON, STARTING, LIMIT_S - 1, "", ""),
        (TRIAL, ON, STARTING, LIMIT_S, FELL_BACK, "no frames within 120 s (activating)"),
        # What ran before is active still: that is no sign of the new one.
        (TRIAL, {}, WELL, 20, "", ""),
        (TRIAL, ON | {"trial": "s"}, WELL, 20, "", ""),
        (TRIAL, ON | {"trial": "s"}, WELL, LIMIT_S, FELL_BACK, "no frames within 120 s"),
        (TRIAL, ON, WELL._replace(restarts=1, said="x"), 5, FELL_BACK, "ended by itself (x)"),
        (TRIAL, ON | {"name": "", "reason": "it is damaged"}, WELL, 5, FELL_BACK, "it is damaged"),
        # Telemetry, where it was there before.
        (HEARD, ON, WELL, 20, "", ""),
        (HEARD, ON, WELL._replace(telemetry=True), 20, HEALTHY, ""),
        (HEARD, ON, WELL, END_S, FELL_BACK, "the ground station does not hear it"),
        # What comes late has to keep coming as long.
        (TRIAL, ON, WELL._replace(active_s=STEADY_S - 1), END_S - 1, "", ""),
        (TRIAL, ON, WELL._replace(active_s=1), END_S, FELL_BACK, "not steady within 180 s"),
    ],
)
def test_the_decision(
    trial: dict[str, Any],
    running: dict[str, Any],
    seen: Seen,
    elapsed_s: float,
    outcome: str,
    reason: str,
) -> None:
    found, why = watch.decide(trial, running, seen, elapsed_s)
    assert found == outcome and reason in why
    assert bool(why) == (found == FELL_BACK)


@pytest.mark.parametrize(
    ("shown", "expected"),
    [
        ("", Seen()),
        ("ActiveState=activating\nNRestarts=0\n", Seen(said="activating")),
        (
            "ActiveState=active\nNRestarts=2\nStatusText=version 1; telemetry up\n"
            "ActiveEnterTimestampMonotonic=40000000\nResult=success\nExecMainStatus=0\n",
            Seen(True, 60.0, 2, True, "active"),
        ),
        (
            "ActiveState=active\nStatusText=version 1; telemetry up; autopilot armed\n",
            Seen(True, telemetry=True, said="active", armed=True),
        ),
        (
            "ActiveState=activating\nNRestarts=1\nResult=exit-code\nExecMainStatus=2\n"
            "StatusText=version 1; telemetry down\n",
            Seen(False, 0.0, 1, False, "activating, exit-code, status 2"),
        ),
        ("ActiveState=active\nNRestarts=x\nActiveEnterTimestampMonotonic=[not set]\n",
         Seen(True, 0.0, 0, False, "active")),
    ],
)  # fmt: skip
def test_what_systemd_shows(shown: str, expected: Seen) -> None:
    assert service.judge(shown, 100.0) == expected


class Clock:
    """The board's uptime, which passes while the watcher sleeps."""

    def __init__(self, card: Card) -> None:
        self.path, self.now_s = card.at.uptime, 100.0
        self.path.unlink()
        self.sleep(0)
        self.at: dict[float, Callable[[], object]] = {}

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds
        self.path.write_text(f"{self.now_s:.2f} 0.00\n")
        for when in [when for when in getattr(self, "at", {}) if when <= self.now_s]:
            self.at.pop(when)()


def trial_of(card: Card) -> Clock:
    card.take(card.bundle(contents(NEW)))
    card.service.on_restart = card.start
    return Clock(card)


def watched(card: Card, clock: Clock) -> list[str]:
    said: list[str] = []
    watch.watch(card.at, card.service, said.append, clock.sleep)  # type: ignore[arg-type]
    return said


def last(card: Card) -> tuple[str, str]:
    found = json.loads(card.at.last.read_text())
    return found["outcome"], found["reason"]


def test_a_release_that_works_stays(card: Card) -> None:
    clock = trial_of(card)
    said = watched(card, clock)
    assert card.service.restarts == 1 and clock.now_s < 110
    assert last(card) == (HEALTHY, "") and card.choice() == Choice(NEW, "update")
    assert card.names() == {NEW, "current"}
    assert said == [f"{NEW} is on trial, after the image's", f"{NEW}: healthy"]
    assert watched(card, clock) == []


def test_one_that_gives_no_frames_goes_back_within_two_minutes(card: Card) -> None:
    clock = trial_of(card)
    card.service.now = STARTING
    begun_s = clock.now_s
    watched(card, clock)
    assert LIMIT_S <= clock.now_s - begun_s < LIMIT_S + 3
    reason = f"{NEW}: no frames within 120 s (activating)"
    assert last(card) == (FELL_BACK, reason)
    assert card.names() == set() and card.service.restarts == 2
    assert card.choice() == Choice("", "fell back", reason)


def test_an_emulated_board_gets_the_time_that_it_takes(card: Card) -> None:
    assert watch.status(card.at)["limit_s"] == END_S
    card.at.board.write_text('{"board": "qemu"}')
    clock = trial_of(card)
    card.service.now = STARTING
    begun_s = clock.now_s
    watched(card, clock)
    limit_s = watch.status(card.at)["limit_s"]
    assert 220 <= clock.now_s - begun_s < 223 and limit_s == 220 + STEADY_S
    assert last(card) == (FELL_BACK, f"{NEW}: no frames within 220 s (activating)")


def test_frames_have_to_keep_coming_for_a_minute(card: Card) -> None:
    """One that ends goes back at once."""
    clock = trial_of(card)
    card.service.now = WELL._replace(active_s=0)
    clock.at[150.0] = lambda: setattr(card.service, "now", WELL._replace(active_s=50))
    hung = Seen(restarts=1, said="activating, watchdog")
    clock.at[155.0] = lambda: setattr(card.service, "now", hung)
    watched(card, clock)
    assert last(card) == (FELL_BACK, f"{NEW}: the firmware ended by itself ({hung.said})")
    assert clock.now_s < 160 and card.choice().name == ""


def test_one_that_the_ground_no_longer_hears_goes_back(card: Card) -> None:
    card.service.now = card.service.now._replace(telemetry=True)
    clock = trial_of(card)
    card.service.now = card.service.now._replace(telemetry=False)
    watched(card, clock)
    assert last(card)[0] == FELL_BACK and "does not hear it" in last(card)[1]
    clock.path.unlink()
    clock.path.symlink_to("/proc/uptime")
    card.service.now = card.service.now._replace(telemetry=True)
    clock = trial_of(card)
    watched(card, clock)
    assert last(card) == (HEALTHY, "")


def test_a_firmware_that_nobody_starts_is_started_again(card: Card) -> None:
    clock = trial_of(card)
    card.service.on_restart = lambda: None
    card.service.now = Seen(said="inactive")
    watched(card, clock)
    assert 4 <= card.service.restarts <= 6 and last(card)[0] == FELL_BACK


def test_a_slow_board_that_is_starting_it_is_left_alone(card: Card) -> None:
    clock = trial_of(card)
    card.service.on_restart = lambda: setattr(card.service, "now", STARTING)

    def up() -> None:
        card.start()
        card.service.now = WELL

    clock.at[180.0] = up
    watched(card, clock)
    assert card.service.restarts == 1 and last(card) == (HEALTHY, "")


def test_a_board_that_loses_power_in_its_trial_gets_the_whole_time_again(card: Card) -> None:
    clock = trial_of(card)
    card.service.now = STARTING

    class Off(Exception):
        pass

    def off() -> None:
        raise Off

    clock.at[150.0] = off
    with pytest.raises(Off):
        watched(card, clock)
    card.boot("boot-2")
    clock.now_s = 3.0
    card.start()  # systemd does
    clock.at[110.0] = lambda: setattr(card.service, "now", WELL)
    watched(card, clock)
    assert last(card) == (HEALTHY, "") and clock.now_s >= 110
    assert card.service.restarts == 1  # of the first boot


def test_a_board_that_loses_power_each_time_is_back_on_the_old_release(card: Card) -> None:
    clock = trial_of(card)
    names = []
    for boot in range(choose.STARTS + 1):
        card.boot(f"boot-{boot + 2}")
        clock.now_s = 3.0
        names.append(card.start().name)
    assert names == [NEW] * choose.STARTS + [""]
    watched(card, clock)  # the first boot that lasts
    assert last(card) == (FELL_BACK, f"{NEW}: started 3 times without getting healthy")
    assert card.names() == set()


@pytest.mark.parametrize("healthy", [True, False])
def test_power_may_go_at_every_change_of_the_decision(
    card: Card, tmp_path: Path, healthy: bool
) -> None:
    trial_of(card)
    card.start()
    trial = choose.read_trial(card.at)
    assert trial is not None
    clean = tmp_path / "clean"
    shutil.copytree(card.root, clean, symlinks=True)
    outcome, reason = (HEALTHY, "") if healthy else (FELL_BACK, "why")
    changes, done = 0, False
    while not done:
        shutil.rmtree(card.root)
        shutil.copytree(clean, card.root, symlinks=True)
        with cut_after(changes):
            try:
                shelf.finish(card.at, card.service, trial, outcome, reason)  # type: ignore[arg-type]
                done = True
            except PowerCut:
                pass
        decided = card.at.last.exists()
        card.boot(f"boot-{changes + 2}")
        chosen = card.start()
        if decided and not healthy and card.at.linked("current") == "":
            assert chosen == Choice("", "fell back", "why")
        card.service.now = WELL if healthy else STARTING
        if decided:  # said once is done, whatever the firmware does now
            card.service.now = STARTING if healthy else WELL
        clock = Clock(card)
        watched(card, clock)
        shelf.prune(card.at)
        assert card.names() == ({NEW, "current"} if healthy else set()), changes
        assert last(card)[0] == outcome and "interrupted" not in last(card)[1]
        changes += 1
    assert changes > 5


def test_status_tells_what_runs_and_what_became_of_the_last_one(card: Card) -> None:
    status = watch.status(card.at)
    assert status["in_force"]["name"] == "" and status["last"] is None and status["trial"] == ""
    clock = trial_of(card)
    assert watch.status(card.at)["trial"] == json.loads(card.at.trial.read_text())["id"]
    watched(card, clock)
    status = watch.status(card.at)
    assert status["in_force"]["version"] == status["in_force"]["name"] == NEW
    assert status["last"]["outcome"] == HEALTHY and json.dumps(status)


@pytest.mark.parametrize("kind", ["pipe", "link"])
def test_what_the_firmware_lays_into_its_folder_holds_up_no_root(card: Card, kind: str) -> None:
    if kind == "pipe":
        os.mkfifo(card.at.running)
    else:
        secret = card.root / "secret.json"
        secret.write_text('{"release": "of root"}')
        card.at.running.symlink_to(secret)
    assert watch.status(card.at)["running"] is None


@pytest.mark.parametrize("armed", [False, True])
def test_a_release_whose_bits_rot_goes_back(card: Card, armed: bool) -> None:
    watched(card, trial_of(card))
    card.service.now = WELL._replace(armed=armed)
    before = card.service.restarts
    assert watch.verify(card.at, card.service) == ""  # type: ignore[arg-type]
    assert card.choice() == Choice(NEW, "update")
    path = card.at.folder(NEW) / "site/native.so"
    rotten = bytearray(path.read_bytes())
    rotten[5000] ^= 1  # of the same size
    path.write_bytes(rotten)
    found = watch.verify(card.at, card.service)  # type: ignore[arg-type]
    assert found == "site/native.so: the card reads other bytes than it was given"
    assert card.choice() == Choice("", "fell back", f"{NEW}: {found}")
    assert card.service.restarts == before + (not armed)
    assert watch.verify(card.at, card.service) == ""  # type: ignore[arg-type]
