"""`python -m hw`: what it prints, what it refuses in one line, and its exit status."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from hw import answering
from hw.__main__ import main
from hw.builds import BUILDS_FILE, load_builds

ROOT = Path(__file__).parents[2]


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    try:
        status = main(arguments)
    except SystemExit as end:  # argparse's way out
        status = end.code
    out, err = capsys.readouterr()
    assert status == 2 and out == ""
    assert err.count("\n") == 1 and err.startswith("python -m hw")
    return err


def test_the_thesiss_numbers_as_a_user_types_them() -> None:
    numbers = ("--volume-m3", "0.1905", "--air-kg-m3", "1.2260", "--helium-kg-m3", "0.1693")
    done = subprocess.run(
        [sys.executable, "-m", "hw", "buoyancy", *numbers],
        cwd=ROOT, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0 and done.stderr == ""
    assert done.stdout.startswith("201.3 g gross")
    assert "the thesis prints 202.1 g" in done.stdout


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("buoyancy --volume-m3 1 --temperature-c 500", "temperature_C is 500; allowed: -40 to 60"),
        ("buoyancy --volume-m3 1 --temperature 20", "--temperature has no unit"),
        ("buoyancy --volume 0.19", "--volume has no unit; allowed: --volume-m3"),
        ("buoyancy --volume-m3 0.19m3", "volume_m3 is '0.19m3'; allowed: a number, the unit m³"),
        ("buoyancy --volume-m3 nan", "volume_m3 is nan; allowed: 0.0001 to 1000 m³"),
        ("buoyancy --volume-m3 inf", "volume_m3 is inf"),
        ("buoyancy --volume-m3 1 --payload-g=-5", "payload_g is -5; allowed: 0 to 1e+06 g"),
        ("buoyancy --volume-m3 1 --purity-percent 0.97", "purity_percent is 0.97; allowed: 50"),
        ("buoyancy --volume-m3 1 --altitude-m 100 --pressure-hpa 900", "allowed: one of them"),
        ("buoyancy --volume-m3 1 --build atrium", "a build are given; allowed: one of them"),
        ("buoyancy --volume-m3 1 --free-lift-g 5", "volume_m3 and free_lift_g are given"),
        ("buoyancy --volume-m3 1 --film-g-m2 27", "film_g_m2 is given; allowed: with a shape"),
        ("buoyancy --volume-m3 1 --solve ballast", "solve is given; allowed: of a build only"),
        ("buoyancy --shape cube", "diameter_m is missing"),
        ("buoyancy --shape ellipsoid --length-m 1", "width_m is missing"),
        ("buoyancy --diameter-m 1", "diameter_m is given without --shape"),
        ("buoyancy --free-lift-g 90 --temperature-c 20", "temperature_C is given; allowed: not"),
        ("buoyancy --build atrium --payload-g 5", "payload_g is given; allowed: a build has its"),
        ("buoyancy --build nope", "build 'nope' is unknown; there are: zero-w-ina219"),
        ("buoyancy --solve battery --required-g 500", "for the cell; allowed: above 0"),
        ("endurance --health-percent 0", "health_percent is 0; allowed: 10 to 100 %"),
        ("endurance --capacity-mah -1", "capacity_mAh is -1; allowed: 50 to 20000 mAh"),
        ("budget --out /dev/null/none", "/dev/null/none: Not a directory"),
        ("fly", "invalid choice: 'fly'"),
        ("", "required: COMMAND"),
    ],
)
def test_what_cannot_be_is_one_line(
    capsys: pytest.CaptureFixture[str], words: str, says: str
) -> None:
    assert says in refused(capsys, *words.split())


def test_lift_comes_with_leak_and_margin(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    words = ("buoyancy --shape pillow --diameter-m 0.965 --film-g-m2 27 --purity-percent 93"
             " --leak-percent-per-day 2 --days 3 --payload-g 60 --json")  # fmt: skip
    assert main([*words.split(), str(tmp_path / "b.json")]) == 0
    document = json.loads((tmp_path / "b.json").read_text())
    assert document["gross_now_g"] == pytest.approx(document["gross_g"] * 0.98**3)
    masses = document["masses"]
    assert masses["envelope_g"] == pytest.approx(39.5, abs=0.1)
    assert document["margin_g"] == pytest.approx(document["gross_now_g"] - sum(masses.values()))
    assert f"{document['margin_g']:+.1f} g margin" in capsys.readouterr().out


def test_the_default_budget_is_positive_and_leaves_table_plots_and_numbers(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main(["budget", "--out", str(tmp_path / "budget")]) == 0
    out = capsys.readouterr().out
    assert "margin" in out and "stream" in out
    made = sorted(path.name for path in (tmp_path / "budget").iterdir())
    assert made == ["budget.json", "budget.txt", "endurance.png", "lift.png", "margin.png"]
    for name in ("endurance", "lift", "margin"):
        data = (tmp_path / "budget" / f"{name}.png").read_bytes()
        assert data.startswith(b"\x89PNG") and len(data) > 10_000
    document = json.loads((tmp_path / "budget" / "budget.json").read_text())
    total = sum(item["mass_g"] for item in document["items"])
    assert document["margin"]["margin_g"] == pytest.approx(
        document["margin"]["gross_g"] - total, abs=1e-4
    )


def test_a_build_that_is_too_heavy_ends_with_status_1(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    heavy = tmp_path / "builds.toml"
    heavy.write_text(BUILDS_FILE.read_text().replace("diameter_m = 1.0775", "diameter_m = 0.9"))
    monkeypatch.setattr(answering, "shipped_builds", lambda: load_builds(heavy))
    assert main(["budget"]) == 1
    out, err = capsys.readouterr()
    assert "does not climb" in out
    assert err.count("\n") == 1 and err.startswith("the margin is -") and "above 0" in err


def test_a_cell_that_is_too_small_for_streaming_ends_with_status_1(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["endurance"]) == 0
    assert "refused" not in capsys.readouterr().out
    assert main(["endurance", "--capacity-mah", "600"]) == 1
    assert "refused: stream: 1.1" in capsys.readouterr().out
    assert main(["endurance", "--build", "zero-2-w-max17048-autopilot"]) == 0
    assert "warning: peak takes 1.9" in capsys.readouterr().out


@pytest.mark.parametrize("question", ["envelope", "battery", "ballast"])
def test_the_questions_backwards_are_answered(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, question: str
) -> None:
    out = tmp_path / "answer.json"
    assert main(["buoyancy", "--solve", question, "--required-g", "5", "--json", str(out)]) == 0
    assert capsys.readouterr().out.count("\n") == 1
    assert {"envelope": "envelope", "battery": "cell", "ballast": "ballast_g"}[question] in (
        json.loads(out.read_text())
    )


def test_help_is_instant_and_shows_an_example() -> None:
    script = "import sys; from hw.command import parser; print(parser().format_help());" \
        "sys.exit('CoolProp' in sys.modules or 'matplotlib' in sys.modules)"  # fmt: skip
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0 and "Example: python -m hw" in done.stdout
