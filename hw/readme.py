"""The page's tables, kept equal to the program: what stands between two markers is its output."""

from __future__ import annotations

import re
from pathlib import Path

from hw import output, tables
from hw.buoyancy import reckon
from hw.catalogue import shipped_builds
from hw.endurance import Wear
from hw.parts import shipped_parts
from hw.quantities import HardwareError
from hw.wiring import GAUGES, drawing
from pi_firmware.wire.errors import told

PAGE = Path(__file__).with_name("README.md")


def sections() -> dict[str, str]:
    """Markdown by marker."""
    catalogue, parts = shipped_builds(), shipped_parts()
    build = catalogue.named(None)
    endurance, _ = tables.endurance_table(build, Wear())
    made = {
        "parts": tables.bill_of_materials(parts),
        "sources": tables.citations(parts),
        "builds": tables.builds_table(catalogue),
        "mass": tables.mass_budget(build, reckon(build)),
        "answers": tables.answers(build),
        "endurance": endurance,
        "erratum": tables.erratum(),
    }
    return {name: table.markdown() for name, table in made.items()}


def filled(page: str) -> str:
    """The page with each marked stretch made again; raises `HardwareError` for a missing marker."""
    for name, text in sections().items():
        pattern = re.compile(rf"(<!-- {name}: made .*?-->\n).*?(<!-- /{name} -->)", re.DOTALL)
        found = list(pattern.finditer(page))
        if len(found) != 1:
            raise HardwareError(f"{PAGE.name}: {name!r} is marked {len(found)} times; allowed: 1")
        page = f"{page[: found[0].end(1)]}{text}\n{page[found[0].start(2) :]}"
    return page


def drawings() -> dict[Path, str]:
    """The committed drawings and what the program makes of them."""
    return {PAGE.with_name(f"wiring-{gauge}.svg"): drawing(gauge) for gauge in GAUGES}


def write() -> list[Path]:
    """Writes tables into the page, and the drawings beside it; raises `HardwareError`."""
    with told(PAGE, HardwareError):
        page = PAGE.read_text(encoding="utf-8")
    output.write_text(PAGE, filled(page))
    for path, text in drawings().items():
        output.write_text(path, text)
    return [PAGE, *drawings()]
