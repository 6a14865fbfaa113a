"""Tables that the command prints and the page shows: the same rows, as text or as Markdown.

What stands between two markers of the page is the program's output, and so are its drawings.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hw import output
from hw.builds import Build, Catalogue, shipped_builds
from hw.buoyancy import THESIS_GROSS_G, Margin, gross_lift_g, gross_of, margin_g, margin_of, sigmas
from hw.endurance import MODES, Endurance, Wear, fly
from hw.flight import balance_of, climb_of
from hw.inverse import ballast_to_neutral, most_battery, payload_cell, smallest_envelope
from hw.parts import Part, shipped_parts
from hw.quantities import HardwareError
from hw.wiring import GAUGES, drawing
from pi_firmware.wire.errors import os_errors_as

CLIMB_M = 3.0


@dataclass(frozen=True)
class Table:
    """A header and rows of text; columns from `right` on hold numbers and stand to the right."""

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    right: int = 1

    def text(self) -> str:
        """Aligned for a terminal."""
        lines = [self.header, *self.rows]
        widths = [max(len(line[c]) for line in lines) for c in range(len(self.header))]
        return "\n".join(
            "  ".join(
                cell.rjust(w) if c >= self.right else cell.ljust(w)
                for c, (cell, w) in enumerate(zip(line, widths, strict=True))
            ).rstrip()
            for line in lines
        )

    def markdown(self) -> str:
        """As GitHub shows it."""
        rule = ["--:" if c >= self.right else "---" for c in range(len(self.header))]
        lines: list[Sequence[str]] = [self.header, rule, *self.rows]
        return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def bill_of_materials(parts: dict[str, Part]) -> Table:
    """Every part: mass, where that comes from, currents, what to order."""
    rows = []
    for part in parts.values():
        draws = max(part.idle_mA, part.stream_mA, part.peak_mA) > 0
        currents = f"{part.idle_mA:g} / {part.stream_mA:g} / {part.peak_mA:g}" if draws else "–"
        source = "**weigh it** (estimated)" if part.weigh_it else part.source
        rows.append((
            f"`{part.id}`", part.name, f"{part.manufacturer}: {part.part_number}", source,
            f"{part.mass_g:g} ± {part.spread_g:g}", f"{part.supply_V:g}" if draws else "–",
            currents,
        ))  # fmt: skip
    header = ("id", "part", "order", "mass is from", "g", "V", "mA idle / stream / peak")
    return Table(header, tuple(rows), right=4)


def citations(parts: dict[str, Part]) -> Table:
    """Where each part's mass and currents come from."""
    rows = tuple(
        (f"`{part.id}`", part.citation, part.power_citation or "–") for part in parts.values()
    )
    return Table(("id", "mass", "current"), rows, right=3)


def mass_budget(build: Build, margin: Margin) -> Table:
    """The build part by part, g, down to the margin with one standard deviation."""
    rows = [
        (item.name, item.source, f"{item.mass_g:.1f}", f"{item.spread_g:.1f}")
        for item in build.items
    ]
    weighed = {item.name for item in build.items}
    sigmas_g = margin.parts_sigma_g.items()
    mass_sigma = math.hypot(*(sigma for name, sigma in sigmas_g if name in weighed))
    lift_sigma = math.hypot(*(sigma for name, sigma in sigmas_g if name not in weighed))
    rows += [
        ("all that flies", "", f"{margin.mass_g:.1f}", f"{mass_sigma:.1f}"),
        ("gross lift", "", f"{margin.gross_g:.1f}", f"{lift_sigma:.1f}"),
        ("margin", "", f"{margin.margin_g:+.1f}", f"{margin.sigma_g:.1f}"),
    ]
    return Table(("what", "mass is from", "g", "±"), tuple(rows), right=2)


def builds_table(catalogue: Catalogue) -> Table:
    """All builds: mass, margin, minutes when streaming, pitch."""
    rows = []
    for build in catalogue.builds.values():
        flown, sigma = fly(build), math.hypot(*sigmas(build).values())
        pitch = balance_of(build).pitch_deg
        rows.append((
            f"`{build.name}`", f"{gross_of(build):.0f}", f"{build.mass_g:.0f}",
            f"{margin_g(build):+.0f} ± {sigma:.0f}", f"{flown.minutes:.0f}",
            f"{flown.end_A:.2f} of {flown.rating_A:g}",
            "turns over" if pitch is None else f"{_zero(pitch):+.1f}",
        ))  # fmt: skip
    header = ("build", "gross lift, g", "mass, g", "margin, g", "minutes streaming",
              "cell, A at the end", "pitch, ° (+ nose down)")  # fmt: skip
    return Table(header, tuple(rows))


def endurance_table(build: Build, wear: Wear) -> tuple[Table, list[Endurance]]:
    """The payload's minutes in each mode, and the cell's current against its rating."""
    flights = [fly(build, mode, wear) for mode in MODES]
    rows = tuple(
        (
            f.mode, f"{f.load_W:.2f}", f"{f.minutes:.0f}", f"{f.full_A:.2f}", f"{f.end_A:.2f}",
            f"{f.c_rate:.2f}", f"{f.rating_A:g}", f.verdict,
        )
        for f in flights
    )  # fmt: skip
    header = ("mode", "load, W", "minutes", "A, full", "A, at the end", "C", "A allowed", "verdict")
    return Table(header, rows), flights


def answers(build: Build) -> Table:
    """The questions backwards, and how it hangs and climbs."""
    balance, climb = balance_of(build), climb_of(build, CLIMB_M)
    rows = [(
        "centre of mass from centre of buoyancy",
        f"{100 * balance.forward_m:+.1f} cm forward, {100 * balance.up_m:+.1f} cm up",
    )]  # fmt: skip
    pitch, hangs = balance.pitch_deg, "turns over"
    if pitch is not None:
        hangs = f"{abs(pitch):.1f}° nose {'down' if pitch > 0 else 'up'}"
    rows.append(("pitch at rest", hangs))
    rows.append((
        f"time to climb {CLIMB_M:g} m with all the margin",
        "does not climb" if climb is None else f"{climb:.1f} s",
    ))  # fmt: skip
    if build.hull.free_lift_g is None:
        size = smallest_envelope(build)
        rows.append((
            "smallest envelope of this shape that lifts it",
            f"{size.volume_m3:.3f} m³, {size.length_m:.2f} × {size.width_m:.2f}"
            f" × {size.height_m:.2f} m",
        ))  # fmt: skip
    if margin_g(build) > 0:
        cell, now = most_battery(build), payload_cell(build)
        rows.append((
            "largest cell of this kind",
            f"{cell.capacity_mAh:.0f} mAh, {cell.mass_g:.0f} g (now {now.capacity_mAh:.0f} mAh)",
        ))  # fmt: skip
        rows.append(("ballast to neutral, in all", f"{ballast_to_neutral(build):.1f} g"))
    return Table(("question", "answer"), tuple(rows), right=2)


def erratum() -> Table:
    """The thesis's lift in its own units and in those that give its sentence a meaning."""
    right = gross_lift_g(0.1905, 1.2260, 0.1693)
    rows = (
        ("volume", "0.1905 cm³", "0.1905 m³"),
        ("density of air", "1226.0 g/cm³", "1226.0 g/m³ = 1.2260 kg/m³"),
        ("density of helium", "169.3 g/cm³", "169.3 g/m³ = 0.1693 kg/m³"),
        ("0.1905 × (1226.0 − 169.3)", f"{THESIS_GROSS_G} g", f"{right:.1f} g"),
    )
    return Table(("", "printed", "meant"), rows, right=3)


def _zero(value: float) -> float:
    """No minus sign before what is printed as 0.0."""
    return 0.0 if abs(value) < 0.05 else value


PAGE = Path(__file__).with_name("README.md")


def sections() -> dict[str, str]:
    """Markdown by marker."""
    catalogue, parts = shipped_builds(), shipped_parts()
    build = catalogue.named(None)
    endurance, _ = endurance_table(build, Wear())
    made = {
        "parts": bill_of_materials(parts),
        "sources": citations(parts),
        "builds": builds_table(catalogue),
        "mass": mass_budget(build, margin_of(build)),
        "answers": answers(build),
        "endurance": endurance,
        "erratum": erratum(),
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


def write_readme() -> list[Path]:
    """Writes tables into the page, and the drawings beside it; raises `HardwareError`."""
    with os_errors_as(PAGE, HardwareError):
        page = PAGE.read_text(encoding="utf-8")
    output.write_text(PAGE, filled(page))
    for path, text in drawings().items():
        output.write_text(path, text)
    return [PAGE, *drawings()]
