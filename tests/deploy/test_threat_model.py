"""Each promise of the threat model names tests that are there."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_each_promise_names_the_tests_that_hold_it() -> None:
    page = (ROOT / "deploy/README.md").read_text()
    table = re.search(r"^\| promised \|.*\n\|---\|---\|\n((?:\|.*\n)+)", page, re.MULTILINE)
    assert table is not None
    for row in table[1].splitlines():
        tests = re.findall(r"`(\S+\.py)::(test_\w+)`", row)
        assert tests, row
        for path, name in tests:
            source = (ROOT / "tests" / path).read_text()
            assert re.search(rf"^def {name}\(", source, re.MULTILINE), f"{path}::{name}"
