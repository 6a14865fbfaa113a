"""Every reader takes its seeds and its past findings, and a moment of the fuzzer's own inputs."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import run as fuzzing
from table import READERS

_LIMIT_S = 900


def moment(action: str, folder: Path) -> None:
    done = subprocess.run(
        [sys.executable, str(fuzzing.HERE / "moment.py"), action],
        capture_output=True,
        text=True,
        cwd=fuzzing.ROOT,
        env={
            **os.environ,
            "TMPDIR": str(folder),
            "OPENBLAS_NUM_THREADS": "1",
            "PYTHONHASHSEED": "0",
        },
        timeout=_LIMIT_S,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-8000:] + done.stderr[-2000:]
    assert f"{len(READERS)} readers" in done.stdout


def test_every_module_of_a_reader_stands_in_the_table() -> None:
    modules = list((fuzzing.HERE / "readers").glob("*.py"))
    named = {path.stem for path in modules if "\ndef fuzz(" in path.read_text(encoding="utf-8")}
    assert named == {reader.name for reader in READERS}
    findings = fuzzing.REGRESSIONS.iterdir() if fuzzing.REGRESSIONS.is_dir() else ()
    assert {path.name for path in findings if path.is_dir()} <= named


def test_seeds_and_past_findings_are_taken(tmp_path: Path) -> None:
    moment("play", tmp_path)


@pytest.mark.skipif(not fuzzing.has_atheris(), reason=fuzzing.NO_ATHERIS)
def test_a_moment_of_fuzzing_finds_nothing(tmp_path: Path) -> None:
    moment("fuzz", tmp_path)


def played(tmp_path: Path, body: str, hang_s: float) -> subprocess.CompletedProcess[str]:
    """A reader of this test's own, given its seed."""
    (tmp_path / "readers").mkdir()
    (tmp_path / "readers" / "__init__.py").touch()
    text = f"def fuzz(data):\n    {body}\n\ndef seeds():\n    return [b'abc']\n"
    (tmp_path / "readers" / "bad.py").write_text(text)
    code = (
        f"import sys; sys.path.insert(0, {str(fuzzing.HERE)!r}); import child, moment;"
        f"sys.path.insert(0, {str(tmp_path)!r}); child.HANG_S = {hang_s};"
        "module = child.load('bad'); moment._play('bad', module)"
    )
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False
    )


@pytest.mark.parametrize(
    ("body", "hang_s", "says"),
    [
        ("raise KeyError(1)", 60, "KeyError"),
        ("while True: pass", 1, "no end within 1 s"),
        ("len(bytes(1) * (1100 << 20))", 60, "MB were in memory; allowed: 1024"),
    ],
)
def test_what_a_reader_may_not_do_is_a_finding(
    tmp_path: Path, body: str, hang_s: float, says: str
) -> None:
    done = played(tmp_path, body, hang_s)
    assert done.returncode != 0 and says in done.stderr


def test_a_reader_that_is_not_there_is_refused_in_one_line(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert fuzzing.main(["nobody"]) == 2
    assert capsys.readouterr().err.startswith("fuzz: no reader 'nobody' (there are: annexb, ")
    assert fuzzing.main(["--seconds", "0"]) == 2
