"""`make limits` against a made-up system: what it keeps, goes on with, accepts and refuses."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import limits
import limits_store
import pytest
from limits_axes import AXES, Conditions, chosen
from limits_stand import Flight, Measured, TrialError
from limits_store import BLOCK, accept, render

from ground_station.errors import GroundStationError
from pi_firmware.settings import Settings
from pi_firmware.wire.config import apply_override, from_mapping


class Made:
    """A system that bears up to 2 % loss and 50 ms jitter, and counts how often it flies."""

    def __init__(self, others: float = 0.01, stops_after: int = 10**6) -> None:
        self.flown = 0
        self._others, self._stops_after = others, stops_after

    def __call__(self, flight: Flight, under: Conditions, seed: int) -> Measured:
        if self.flown == self._stops_after:
            raise KeyboardInterrupt
        self.flown += 1
        loss, jitter_s = under.impairment.get("loss", 0), under.impairment.get("jitter_s", 0)
        share = 0.99 - 0.001 * seed if loss <= 0.02 and jitter_s <= 0.05 else 0.9 - 0.01 * seed
        return Measured(share, others_cores=self._others)


def document(out: Path) -> dict[str, Any]:
    return dict(json.loads(out.read_text()))


def test_limits_of_the_made_up_system_are_found_and_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "deep" / "limits.json"
    assert limits.main(["--out", str(out), "--only", "loss,jitter"], Made()) == 0
    axes = document(out)["axes"]
    assert (axes["loss"]["sustained"], axes["loss"]["refused"]) == ("2 %", "3 %")
    assert (axes["jitter"]["sustained"], axes["jitter"]["refused"]) == ("50 ms", "100 ms")
    assert axes["loss"]["shares"]["2 %"] == pytest.approx([0.989, 0.988, 0.987])
    said = capsys.readouterr()
    assert "| 2 % | 98.7 to 98.9 % | 3 % | 89 % |" in said.out  # given up at its first run
    assert out.with_suffix(".md").read_text() == said.out
    assert "loss: 2 %, seed 1: 98.9 % TRACKING" in said.err


def test_a_run_that_was_stopped_goes_on_where_it_was(tmp_path: Path) -> None:
    out, whole = tmp_path / "limits.json", Made()
    limits.main(["--out", str(tmp_path / "whole.json"), "--only", "loss"], whole)
    first, second = Made(stops_after=5), Made()
    assert limits.main(["--out", str(out), "--only", "loss"], first) == 130
    kept = document(out)
    assert len(kept["trials"]) == 5 and not kept["axes"]["loss"]["complete"]
    assert limits.main(["--out", str(out), "--only", "loss"], second) == 0
    assert first.flown + second.flown == whole.flown
    assert document(out)["axes"]["loss"]["sustained"] == "2 %"


def test_an_axis_measured_later_joins_the_others_of_the_file(tmp_path: Path) -> None:
    out = tmp_path / "limits.json"
    for name in ("loss", "jitter"):
        assert limits.main(["--out", str(out), "--only", name], Made()) == 0
    assert list(document(out)["axes"]) == ["loss", "jitter"]


def test_what_was_disturbed_is_measured_anew_when_asked(tmp_path: Path) -> None:
    out, busy, quiet = tmp_path / "limits.json", Made(others=1.5), Made()
    limits.main(["--out", str(out), "--only", "loss"], busy)
    assert document(out)["axes"]["loss"]["others_cores_most"] == 1.5
    assert limits.main(["--out", str(out), "--only", "loss", "--undisturbed"], quiet) == 0
    assert quiet.flown == busy.flown
    assert document(out)["axes"]["loss"]["others_cores_most"] == 0.01


def test_a_trial_that_fails_is_no_limit_and_the_other_axes_go_on(tmp_path: Path) -> None:
    made = Made()

    def fails(flight: Flight, under: Conditions, seed: int) -> Measured:
        if under.impairment.get("loss"):
            raise TrialError("a trial's program ended with status -11: nothing")
        return made(flight, under, seed)

    out = tmp_path / "limits.json"
    assert limits.main(["--out", str(out), "--only", "loss,jitter"], fails) == 1
    axes = document(out)["axes"]
    assert not axes["loss"]["complete"] and "status -11" in axes["loss"]["problem"]
    assert axes["jitter"]["complete"]


def readme(folder: Path, table: str = "old\n") -> Path:
    path = folder / "README.md"
    path.write_text(f"before\n{BLOCK.begin}\n{table}{BLOCK.end}\nafter\n")
    return path


def measured(out: Path, **options: float) -> dict[str, Any]:
    limits.main(["--out", str(out), "--only", "loss,jitter"], Made(**options))  # type: ignore[arg-type]
    return document(out)


def test_an_accepted_run_is_the_table_between_the_markers(tmp_path: Path) -> None:
    path, kept = readme(tmp_path), tmp_path / "accepted.json"
    run = measured(tmp_path / "limits.json")
    accept(run, path, kept)
    text = path.read_text()
    assert text.startswith("before\n") and text.endswith(f"{BLOCK.end}\nafter\n")
    assert BLOCK.read(text) == render(document(kept)) == render(run)
    assert "trials" not in document(kept) and kept.stat().st_size < 8000
    accept(run, path, kept)
    assert path.read_text() == text


def test_a_run_that_was_disturbed_or_cut_short_is_not_accepted(tmp_path: Path) -> None:
    path, kept = readme(tmp_path), tmp_path / "accepted.json"
    before = path.read_text()
    for number, (options, word) in enumerate(
        (({"others": 0.5}, "others used 0.5"), ({"stops_after": 4}, "not measured to its end"))
    ):
        run = measured(tmp_path / f"{number}.json", **options)
        with pytest.raises(GroundStationError, match=word):
            accept(run, path, kept)
    assert path.read_text() == before and not kept.exists()


def test_the_table_in_the_readme_is_that_of_the_accepted_run() -> None:
    table = BLOCK.read(limits_store.README.read_text())
    assert (table is not None) == limits_store.ACCEPTED.exists()
    if table is not None:
        assert table == render(document(limits_store.ACCEPTED))


def test_a_share_just_below_the_bound_is_not_rounded_up_to_it() -> None:
    run = {
        "machine": {"cores": 2, "model": "A|B", "load_before": 0.1, "date": "2026-01-01"},
        "seeds": [1, 2], "duration_s": 32.0, "borne_from": 0.95, "flight": "f.mcap, 1",
        "axes": {"loss": {
            "title": "loss", "sustained": None, "refused": "none", "last": False, "odd": [],
            "shares": {"none": [0.94999, 0.9999]}, "held_by": [], "others_cores_most": None,
        }},
    }  # fmt: skip
    text = render(run)
    assert "| loss | nothing | – | none | 94.9 to 99.9 % |" in text and "A|B" not in text


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--only", "loss,wind"], "wind"),
        (["--seed", "1"], "--seed"),
        (["--accept", "--out", "missing.json"], "missing.json"),
    ],
)
def test_bad_input_is_one_line_and_status_2(
    arguments: list[str], word: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    try:
        status: Any = limits.main(arguments, Made())
    except SystemExit as ended:
        status = ended.code
    said = capsys.readouterr().err
    assert status == 2 and said.count("\n") == 1 and word in said


@pytest.mark.parametrize(
    "text", ["", "[]", '{"schema": 1}', '{"schema": 1, "axes": {}, "machine": {}, "trials": [1]}']
)
def test_a_file_that_is_none_of_its_own_is_left_alone(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "limits.json"
    out.write_text(text)
    assert limits.main(["--out", str(out)], Made()) == 2
    assert out.read_text() == text and capsys.readouterr().err.count("\n") == 1


def test_a_quick_run_does_not_overwrite_a_whole_one(tmp_path: Path) -> None:
    out = tmp_path / "limits.json"
    before = measured(out)
    assert limits.main(["--out", str(out), "--quick"], Made()) == 2
    assert document(out) == before


def test_every_axis_begins_without_its_burden_and_names_no_level_twice() -> None:
    assert len({axis.name for axis in AXES}) == len(AXES)
    for axis in AXES:
        texts = [level.text for level in axis.levels]
        assert len(set(texts)) == len(texts) >= 8
    assert [axis.name for axis in chosen(["jitter", "loss"])] == ["loss", "jitter"]


def test_every_level_is_one_that_link_and_firmware_take() -> None:
    from impaired_link import Impairment

    for axis in AXES:
        for level in axis.levels:
            Impairment(**level.under.impairment)
            settings: dict[str, Any] = {}
            for override in level.under.payload:
                apply_override(settings, override, Settings)
            from_mapping(settings, Settings, where=level.text)
