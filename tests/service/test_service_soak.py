"""What the soak of the service says of made-up runs, and what its command line refuses."""

from __future__ import annotations

import argparse
import importlib.util
import sys
from typing import Any

import numpy as np
import pytest
from intake_stand import TESTS
from service_account import Flight, account_rows
from soaking.measures import Window
from soaking.table import Row

# By its path: the firmware's soak has the same name.
_SPEC = importlib.util.spec_from_file_location("service_soak", TESTS / "service" / "soak.py")
assert _SPEC is not None and _SPEC.loader is not None
soak = importlib.util.module_from_spec(_SPEC)
sys.modules["service_soak"] = soak  # where its dataclasses look for their annotations
_SPEC.loader.exec_module(soak)

HOUR = 360


def options(hours: float = 1.0) -> argparse.Namespace:
    return argparse.Namespace(hours=hours, loss=0.02, flight_s=110.0, out=None)


def flight(**changes: int) -> Flight:
    counts = {
        "captured": 110, "gated": 4, "sent": 105, "discarded": 1, "received": 90, "withheld": 10,
        "lost": 5, "processed": 80, "skipped": 10, "localized": 70,
    } | changes  # fmt: skip

    def some(*names: str) -> dict[str, int]:
        return {name: counts[name] for name in names}

    return Flight(
        some("captured", "gated", "sent", "discarded"),
        some("received", "withheld", "lost"),
        some("processed", "skipped", "localized"),
        True,
    )


def run(hours: float = 1.0, leak: float = 0.0, name: str = "web") -> Any:
    """A run in which memory and descriptors of one process rise by `leak` an hour."""
    flown, draw = soak.Flown(), np.random.default_rng(4)
    for k in range(int(HOUR * hours)):
        at_s = 10.0 * k
        for one in soak.PROCESSES:
            risen = leak * at_s / 3600 if one == name else 0.0
            for measure, value in zip(
                flown.watch._of(one),
                (200 + risen + 0.2 * draw.normal(), 40 + int(risen)),
                strict=True,
            ):
                measure.add(at_s, value)
        flown.clock.add(at_s, None if k % 12 == 11 else 0.02 * draw.normal())
        slow = 30 + draw.normal()
        flown.add_latency(Window(at_s, 20.0, slow, 2 * slow, 3 * slow))
    flown.flights = [flight(processed=60), flight(), flight()]
    flown.link, flown.viewer = {"lost": 20, "received": 1000}, {"connections": 1}
    flown.restarts, flown.load = {"web": 0}, [1.0]
    return flown


def missed(table: list[Row]) -> list[str]:
    return [row.name for row in table if not row.holds]


def test_a_run_in_which_nothing_leaks_holds() -> None:
    assert missed(soak.rows(run(), options())) == []


def test_a_leak_of_one_process_is_caught_in_memory_and_descriptors() -> None:
    names = missed(soak.rows(run(leak=40.0), options()))
    assert names == ["memory, web", "memory, web: slope", "descriptors, web: slope"]


def test_a_run_that_was_too_short_does_not_hold() -> None:
    table = soak.rows(run(hours=0.05), options(0.05))
    assert {"memory, web: slope", "descriptors, station: slope"} <= set(missed(table))
    assert "too short to tell" in next(r.value for r in table if r.name == "memory, web: slope")


def test_a_run_that_was_stopped_before_its_first_sample_is_told() -> None:
    table = soak.rows(soak.Flown(), options())
    assert "flights, ended in order" in missed(table)


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"discarded": 2}, "captured − gated = sent + discarded"),
        ({"lost": 4}, "sent = received + withheld + lost"),
        ({"skipped": 9}, "received = processed + skipped"),
    ],
)
def test_a_frame_that_is_not_accounted_for_is_caught(change: dict[str, int], name: str) -> None:
    assert missed(account_rows([flight(), flight(), flight()])) == []
    assert missed(account_rows([flight(), flight(**change), flight()])) == [name]


def test_frames_before_the_localizer_was_up_are_only_the_first_flights() -> None:
    assert missed(account_rows([flight(processed=60), flight()])) == []
    assert missed(account_rows([flight(), flight(processed=60)])) != []
    assert missed(account_rows([flight(processed=81), flight()])) != []


def test_another_process_under_a_name_of_the_service_is_a_restart() -> None:
    flown = run()
    flown.watch.changed = {"payload": 20, "web": 1}
    assert missed(soak.rows(flown, options())) == ["processes restarted"]


@pytest.mark.parametrize(
    "given", [["--hours", "0"], ["--loss", "0"], ["--flight-s", "1"], ["--gap-s", "x"]]
)
def test_bad_input_is_one_line(given: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        soak.main(given)
    said = capsys.readouterr().err
    assert ended.value.code == 2 and said.count("\n") == 1 and repr(given[1]) in said
