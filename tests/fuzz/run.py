"""Fuzzes what reads from outside: `python tests/fuzz/run.py [READER…] [--seconds 120] [--long]`.

Each reader runs in a process of its own with 1 GB of memory and 10 s an input. What it has learnt
is kept in out/fuzz/READER/corpus, so that the next run goes on from there, and what it found in
out/fuzz/READER/findings. Status 1 when there is a finding, 2 for bad input.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
REGRESSIONS = HERE / "regressions"
sys.path.insert(0, str(HERE))
from table import READERS, Reader  # noqa: E402

LONG_S = 600
_MEMORY_MB = 1024
_START_LIMIT_S = 600
"""To import what the reader needs, instrumented, on a machine that does other things, too."""
_SEED = 8
NO_ATHERIS = "atheris is not installed: it has wheels for Linux on x86-64 only"


@dataclass
class Outcome:
    """One reader's run; `coverage` counts libFuzzer's edges, `corpus` the inputs kept."""

    reader: str
    seconds: float = 0.0
    executions: int = 0
    coverage: int = 0
    corpus: int = 0
    peak_MB: int = 0
    slowest_s: int = 0
    findings: list[str] = field(default_factory=list)
    reason: str = ""


def has_atheris() -> bool:
    """Whether this Python has the fuzzer."""
    return importlib.util.find_spec("atheris") is not None


def fuzz(reader: Reader, seconds: int, out: Path) -> Outcome:
    """Fuzzes one reader for so long, or up to its first finding."""
    place = out / reader.name
    corpus, findings = place / "corpus", place / "findings"
    for folder in (corpus, findings):
        folder.mkdir(parents=True, exist_ok=True)
    began_s = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="fuzz-", dir=_quick_place()) as scratch:
        seeds = Path(scratch) / "seeds"
        with (place / "log").open("wb") as log:
            made = _start("seeds", reader.name, str(seeds), log=log, scratch=scratch)
            status = _wait(made, _START_LIMIT_S)
            before = set(findings.iterdir())
            if status == 0:
                folders = [corpus, seeds, *filter(Path.is_dir, [REGRESSIONS / reader.name])]
                options = (
                    f"-max_total_time={seconds}",
                    f"-max_len={reader.most_bytes}",
                    f"-rss_limit_mb={_MEMORY_MB}",
                    f"-artifact_prefix={findings}/",
                    f"-seed={_SEED}",
                    "-print_final_stats=1",
                    "-report_slow_units=1000",  # a busy machine is not a finding
                    "-use_value_profile=1",
                )
                child = _start(
                    "fuzz", reader.name, *options, *map(str, folders), log=log, scratch=scratch
                )
                status = _wait(child, seconds + _START_LIMIT_S)
    text = (place / "log").read_text(errors="replace")
    found = sorted(set(findings.iterdir()) - before)
    outcome = Outcome(reader.name, round(time.monotonic() - began_s, 1))
    outcome.findings = [_shown(path) for path in found]
    if status != 0 or found:
        outcome.reason = _reason(text, status)
    _read_log(outcome, text)
    return outcome


def _start(action: str, *words: str, log: object, scratch: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, str(HERE / "child.py"), action, *words],
        stdin=subprocess.DEVNULL,
        stdout=log,  # type: ignore[call-overload]
        stderr=subprocess.STDOUT,
        cwd=ROOT,
        env={**os.environ, "TMPDIR": scratch, "OPENBLAS_NUM_THREADS": "1"},
    )


def _wait(process: subprocess.Popen[bytes], limit_s: float) -> int | None:
    """The status; None when it had to be killed."""
    try:
        return process.wait(limit_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        return None
    except BaseException:
        process.kill()
        process.wait()
        raise


def _quick_place() -> str | None:
    """Files that are read once are best in memory."""
    shared = "/dev/shm"
    return shared if os.access(shared, os.W_OK) else None


def _read_log(outcome: Outcome, text: str) -> None:
    states = re.findall(r"^#(\d+).*? cov: (\d+) .*?corp: (\d+)/", text, re.MULTILINE)
    if states:
        outcome.executions, outcome.coverage, outcome.corpus = map(int, states[-1])
    stats = dict(re.findall(r"^stat::(\w+): +(\d+)", text, re.MULTILINE))
    outcome.executions = int(stats.get("number_of_executed_units", outcome.executions))
    outcome.peak_MB = int(stats.get("peak_rss_mb", 0))
    outcome.slowest_s = int(stats.get("slowest_unit_time_sec", 0))


def _reason(text: str, status: int | None) -> str:
    """Why it ended, in one line: the exception, or libFuzzer's own word."""
    after = text.rpartition("Uncaught Python exception: ===")[2] if "Uncaught" in text else text
    for pattern in (
        r"^([A-Za-z_.]*(?:Error|Exception|Hang|Group)\b.*)$",
        r"(ERROR: libFuzzer: .*)",
        r"^(.*terminate called.*|F\d{4} .*)$",
    ):
        if match := re.search(pattern, after, re.MULTILINE):
            return match[1][:200]
    return "it did not end in time" if status is None else f"it ended with status {status}"


def _shown(path: Path) -> str:
    return str(path.relative_to(ROOT) if path.is_relative_to(ROOT) else path)


_HEAD = (
    f"{'reader':<14}{'seconds':>8}{'executions':>12}{'coverage':>10}{'corpus':>8}{'peak MB':>9}  "
)


def _row(outcome: Outcome) -> str:
    verdict = f"{len(outcome.findings)} found: {outcome.reason}" if outcome.reason else "-"
    return (
        f"{outcome.reader:<14}{outcome.seconds:>8.0f}{outcome.executions:>12}{outcome.coverage:>10}"
        f"{outcome.corpus:>8}{outcome.peak_MB:>9}  {verdict}"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Fuzzes the readers asked for, all when none is named; prints the table."""
    known = {reader.name: reader for reader in READERS}
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("readers", nargs="*", metavar="READER", help=", ".join(known))
    parser.add_argument("--seconds", type=int, default=120, help="for each reader (120)")
    parser.add_argument("--long", action="store_true", help=f"{LONG_S} s for each reader")
    parser.add_argument("--jobs", type=int, default=1, help="readers at a time (1)")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "fuzz.json", help="the results")
    parser.add_argument("--corpus", type=Path, default=ROOT / "out" / "fuzz", help="what is kept")
    options = parser.parse_args(arguments)
    if unknown := [name for name in options.readers if name not in known]:
        return _refuse(f"no reader {unknown[0]!r} (there are: {', '.join(known)})")
    if not 1 <= options.seconds <= 86_400 or not 1 <= options.jobs <= 64:
        return _refuse("--seconds is 1 to 86400, --jobs 1 to 64")
    if not has_atheris():
        return _refuse(NO_ATHERIS)
    chosen = [known[name] for name in options.readers or known]
    seconds = LONG_S if options.long else options.seconds
    print(_HEAD + "findings", flush=True)
    outcomes = []
    with ThreadPoolExecutor(options.jobs) as pool:
        for outcome in pool.map(lambda r: fuzz(r, seconds, options.corpus.resolve()), chosen):
            print(_row(outcome), flush=True)
            for path in outcome.findings:
                print(f"    again: python tests/fuzz/child.py play {outcome.reader} {path}")
            outcomes.append(outcome)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    part = options.out.with_name(options.out.name + ".part")
    document = {"seconds": seconds, "readers": [asdict(outcome) for outcome in outcomes]}
    part.write_text(json.dumps(document, indent=2) + "\n")
    part.replace(options.out)
    return 1 if any(outcome.reason for outcome in outcomes) else 0


def _refuse(reason: str) -> int:
    print(f"fuzz: {reason}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
