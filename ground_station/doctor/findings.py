"""What a check found, how it is printed, and how a check that breaks itself is reported."""

from __future__ import annotations

import dataclasses
import shutil
import textwrap
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

from pi_firmware.wire.text import printable

OK, WARNING, PROBLEM = "ok", "warning", "problem"
_COLOURS = {OK: "32", WARNING: "33", PROBLEM: "1;31"}
_NARROWEST, _WIDEST = 60, 120
_WORKERS = 4


@dataclass(frozen=True)
class Finding:
    """One line of the doctor's: `level` is ok, warning or problem; `fix` says what to do."""

    name: str
    level: str
    found: str
    fix: str = ""


@dataclass(frozen=True)
class Check:
    """A named check; it gives one finding or several, under its own name or others."""

    name: str
    do: Callable[[], Finding | Iterable[Finding]]


def ok(name: str, found: str) -> Finding:
    """Nothing to fix."""
    return Finding(name, OK, found)


def warning(name: str, found: str, fix: str) -> Finding:
    """It works, but not as well or as surely as it could."""
    return Finding(name, WARNING, found, fix)


def problem(name: str, found: str, fix: str) -> Finding:
    """The service cannot do its work like this."""
    return Finding(name, PROBLEM, found, fix)


def examine(checks: Sequence[Check]) -> list[Finding]:
    """Does all checks, some at once; findings are in the order of the checks.

    A check that raises is a problem in its own line, whatever it raises.
    """
    with ThreadPoolExecutor(_WORKERS, thread_name_prefix="doctor") as pool:
        return [finding for found in pool.map(_guarded, checks) for finding in found]


def _guarded(check: Check) -> list[Finding]:
    try:
        found = check.do()
        return [found] if isinstance(found, Finding) else list(found)
    except Exception as error:  # the next checks are still worth doing
        said = " ".join(f"{type(error).__name__}: {error}".split())[:300]
        return [problem(check.name, f"the check itself failed: {said}", "report this as a defect")]


def document(findings: Sequence[Finding]) -> dict[str, Any]:
    """All findings and how many of each level, for JSON."""
    counts = {level: count(findings, level) for level in (OK, WARNING, PROBLEM)}
    return {"counts": counts, "findings": [dataclasses.asdict(finding) for finding in findings]}


def count(findings: Iterable[Finding], level: str) -> int:
    """How many findings are of a level."""
    return sum(finding.level == level for finding in findings)


def text(findings: Sequence[Finding], *, colour: bool, width: int | None = None) -> str:
    """The findings as a table of at most `width` columns (the terminal's), and a last line."""
    columns = width or shutil.get_terminal_size((100, 24)).columns
    columns = min(max(columns, _NARROWEST), _WIDEST)
    names = max((len(finding.name) for finding in findings), default=0)
    levels = len(PROBLEM)
    indent = names + levels + 4
    lines = []
    for finding in findings:
        level = finding.level.ljust(levels)
        if colour:
            level = f"\x1b[{_COLOURS[finding.level]}m{level}\x1b[0m"
        found = _wrapped(finding.found, columns - indent)
        lines.append(f"{finding.name.ljust(names)}  {level}  {found[0]}")
        lines += [" " * indent + line for line in found[1:]]
        if finding.fix:
            fix = _wrapped(finding.fix, columns - indent - 3)
            lines.append(f"{' ' * indent}-> {fix[0]}")
            lines += [" " * (indent + 3) + line for line in fix[1:]]
    return "\n".join([*lines, "", _summary(findings)])


def _wrapped(said: str, width: int) -> list[str]:
    """Lines of a width; a path or a command's word is never broken."""
    clean = printable(said)
    return textwrap.wrap(clean, max(width, 20), break_long_words=False, break_on_hyphens=False) or [
        ""
    ]


def _summary(findings: Sequence[Finding]) -> str:
    problems, warnings = count(findings, PROBLEM), count(findings, WARNING)
    if not problems and not warnings:
        return f"all {len(findings)} checks are good"
    parts = []
    if problems:
        parts.append(f"{problems} problem{'s' if problems > 1 else ''}")
    if warnings:
        parts.append(f"{warnings} warning{'s' if warnings > 1 else ''}")
    return f"{' and '.join(parts)} in {len(findings)} checks"
