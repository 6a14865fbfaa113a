"""What a bench cannot measure is refused in one line before it begins."""

from __future__ import annotations

from pathlib import Path

import pytest

from ground_station import cli

ATRIUM = Path(__file__).parents[2] / "maps/atrium"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("localize --frames 1", "--frames is 1; allowed: 2 to"),
        ("localize --map nowhere", "nowhere: there is no such map"),
        (f"localize --map {ATRIUM} --landmarks 5 4", "100 <= 5 < 4"),
        ("map", "give one of them"),
        ("map --campus 60 --study atrium", "give one of them"),
        ("map --campus 60 --seeds 0", "--seeds is 0; allowed: 1 to 100"),
        ("map --campus 10", "--campus is 10; allowed: 50 to 100000"),
        ("map --campus 60 --processes 999", "--processes is 999; allowed: 0 to 256"),
        ("map --campus 60 --json nowhere/told.json", "told.json: its folder does not exist"),
        ("map --study attic", "has 'attic'; allowed: atrium, office, corridor, stills"),
        ("features --max-features 3", "--max-features is 3; allowed: 50 to 20000"),
        ("features --threads 99", "--threads is 99"),
        ("features --repetitions 1", "--repetitions is 1"),
        ("features --extractors surf", "no extractor 'surf' (known: "),
    ],
)
def test_a_bad_value_is_one_line_and_status_2(
    words: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["bench", *words.split()]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
