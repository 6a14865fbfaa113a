"""What the project says of itself is held against figures, and a broken claim is said first."""

from __future__ import annotations

import kept_runs
import pytest

from ground_station.experiments import declaration, report, summary, tables
from pi_firmware.wire.errors import ConfigError

FLIGHTS = """seeds = [1, 2]
[experiment.light]
[experiment.light.case.noon]
[experiment.light.case.sunset]
[claim.c]
text = "Sunset is no worse"
row = "light.sunset"
"""
POSITION = "most = 0.05"
RATIO = 'against = "light.noon"\nmost = 2.0'
NOON, SUNSET = [0.01] * 4, [0.03] * 4


def document(tmp_path, claim, sunset, noon=None):
    """Of two rows, of whose default two seeds have those runs; the thesis's were worse."""
    runs = {"noon": [kept_runs.run(NOON)] * 2 if noon is None else noon, "sunset": sunset}
    theirs = [kept_runs.run([0.4] * 4)] * 2
    rows = {("light", case): {"thesis": theirs, "default": ours} for case, ours in runs.items()}
    return kept_runs.document(tmp_path, f"{FLIGHTS}{claim}\n", rows)


@pytest.mark.parametrize(
    ("claim", "kept", "told"),
    [
        (POSITION, True, "kept, 0.03 m (at most 0.05 m)"),
        ("most = 0.02", False, "not kept, 0.03 m (at most 0.02 m)"),
        (RATIO, False, "not kept, 3 times (at most 2 times)"),
        ('against = "light.noon"\nmost = 4.0', True, "kept, 3 times (at most 4 times)"),
        ('figure = "rotation_deg"\nmost = 0.2', False, "not kept, 0.3° (at most 0.2°)"),
        ('preset = "thesis"\nmost = 0.3', False, "not kept, 0.4 m"),
        ('figure = "inside_95"\nleast = 0.9', True, "kept, 0.95 (at least 0.9)"),
        ('figure = "inside_95"\nleast = 0.96', False, "not kept, 0.95 (at least 0.96)"),
    ],
)
def test_a_claim_is_kept_or_not_by_its_row(tmp_path, claim, kept, told):
    found = document(tmp_path, claim, [kept_runs.run(SUNSET)] * 2)
    (one,) = found["claims"]
    assert one["kept"] is kept and told in summary.claim_line(one)
    assert report.good(found) is kept
    assert (told in tables.verdict(found)) is (not kept)
    assert told in report.markdown(found)


def test_a_claim_of_every_seed_falls_with_the_worst(tmp_path):
    runs = [kept_runs.run([0.01] * 4), kept_runs.run([0.07] * 4)]
    assert document(tmp_path, POSITION, runs)["claims"][0]["kept"] is True  # 4 cm in the mean
    worst = document(tmp_path, f'statistic = "max"\n{POSITION}', runs)["claims"][0]
    assert worst["kept"] is False and worst["value"] == pytest.approx(0.07)


@pytest.mark.parametrize(
    ("claim", "kept", "value"),
    [
        ('statistic = "median"\nmost = 0.03', True, 0.03),
        ('statistic = "median"\nmost = 0.02', False, 0.03),
        ('statistic = "p95"\nmost = 0.06', False, 0.064),
        ('statistic = "max"\nmost = 0.07', True, 0.07),
    ],
)
def test_a_claim_of_an_experiment_is_of_all_its_runs(tmp_path, claim, kept, value):
    noon = [kept_runs.run([error] * 4) for error in (0.01, 0.07)]
    claim = claim.replace("statistic", '[claim.all]\ntext = "All"\nrow = "light"\nstatistic')
    found = document(tmp_path, f"{POSITION}\n{claim}", [kept_runs.run(SUNSET)] * 2, noon)
    one = found["claims"][1]
    assert one["kept"] is kept and one["value"] == pytest.approx(value)


def test_a_run_without_a_map_is_worse_than_any_with_one(tmp_path):
    runs = [kept_runs.run(SUNSET), {"failed": "no two images overlap"}]
    for statistic, kept, value in (("median", True, 0.02), ("p95", False, None)):
        claim = f'[claim.all]\ntext = "All"\nrow = "light"\nstatistic = "{statistic}"\n{POSITION}'
        one = document(tmp_path, f"{POSITION}\n{claim}", runs)["claims"][1]
        assert one["kept"] is kept and one["value"] == (value and pytest.approx(value))
    (one,) = document(tmp_path, RATIO, [kept_runs.run(NOON)] * 2, noon=runs)["claims"]
    assert one["kept"] is False  # nothing is small beside what was not found


def test_a_recovery_that_never_came_keeps_nothing(tmp_path):
    claim = 'figure = "recovery_s"\nmost = 1.0'
    found = {"recovery_s": 0.4}
    runs = [kept_runs.run(SUNSET) | found, kept_runs.run(SUNSET)]
    (one,) = document(tmp_path, claim, runs)["claims"]
    assert one["kept"] is False and "no figure in some run" in summary.claim_line(one)
    runs[1] |= found
    assert document(tmp_path, claim, runs)["claims"][0]["kept"] is True


def test_what_was_not_measured_is_neither_kept_nor_broken(tmp_path):
    good, failed = kept_runs.run(NOON), {"failed": "killed", "accident": True}
    (one,) = document(tmp_path, POSITION, [good, failed])["claims"]
    assert one["kept"] is None and summary.claim_line(one).endswith("not measured.")
    (one,) = document(tmp_path, RATIO, [good, good], noon=[failed, good])["claims"]
    assert one["kept"] is None


def test_claims_of_experiments_that_are_not_wanted_are_left_out():
    declared = declaration.load(declaration.SHIPPED, ["illumination"])
    assert {claim.row for claim in declared.claims} > {"illumination.sunset"}
    experiments = [{"name": "motion", "cases": []}]
    assert summary.judge_claims(declared.claims, experiments) == []


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('row = "light.dawn"', "'row' names 'light.dawn', and there is no such row"),
        ('row = "dark"', "'row' names 'dark', and there is no such row"),
        ("", "'row' names '', and there is no such row"),
        ('row = "light.noon"\nagainst = "a.b"', "'against' names 'a.b', and there is no such row"),
        ('row = "light.noon"\nfigure = "price"', "price"),
        ('row = "light.noon"\nmost = nan', "most"),
        ('row = "light.noon"', "one of 'most' and 'least' must be given"),
        ('row = "light.noon"\nmost = 1\nleast = 0', "one of 'most' and 'least' must be given"),
        ('row = "light.noon"\nmuch = 1', "much"),
    ],
)
def test_a_claim_of_nothing_is_refused_by_name(tmp_path, text, words):
    path = tmp_path / "e.toml"
    path.write_text(f"[experiment.light.case.noon]\n[claim.c]\n{text}\n")
    with pytest.raises(ConfigError, match=words):
        declaration.load(path)
    path.write_text("claim.c = 3\n[experiment.light.case.noon]\n")
    with pytest.raises(ConfigError, match="claim: 'c' must be a table"):
        declaration.load(path)


def test_the_verdict_counts_wrong_tracking_and_names_the_worst_covariance(tmp_path):
    sunset = kept_runs.run([0.01, 0.3, 0.5, 0.01])
    low = {"consistency": {"nees": 9.0, "inside_95": 0.46}}
    noon = [kept_runs.run(NOON) | low] * 2
    said = tables.verdict(document(tmp_path, POSITION, [sunset] * 2, noon))
    assert "further off than 0.25 m or 3° in 4 frames of all runs: light, sunset: 4." in said
    assert (
        "In 1 of 2 rows less than 90 % of the poses lie inside their 95 % ellipsoid: light" in said
    )
    assert "light, noon: 46 %." in said
    said = tables.verdict(document(tmp_path, POSITION, [kept_runs.run(SUNSET)] * 2))
    assert "in 0 frames of all runs." in said
    assert "every row 90 % and more of the poses lie inside their 95 % ellipsoid (least in" in said


def test_a_registrations_share_stands_beside_the_error(tmp_path):
    runs = [kept_runs.run(SUNSET) | {"registration_m": 0.012}] * 2
    noon, sunset = document(tmp_path, POSITION, runs)["experiments"][0]["cases"]
    assert "3.00 ± 0.00 cm (1.20 ± 0.00 cm registration's)" in tables.figures(sunset, "default")
    assert "registration" not in tables.figures(noon, "default")
    assert "registration" not in tables.figures(sunset, "thesis")
