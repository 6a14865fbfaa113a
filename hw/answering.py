"""What each command of `python -m hw` computes and prints."""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from hw import inverse, output, tables
from hw.builds import Conditions, shipped_builds, with_ballast
from hw.buoyancy import THESIS_GROSS_G, gross_lift_g, gross_of, margin_g, margin_of
from hw.command import CONDITIONS, MASSES, WEAR
from hw.endurance import Wear
from hw.envelopes import Envelope, of_shape, of_volume
from hw.quantities import HardwareError, checked

_GEOMETRY = ("volume_m3", "shape", "free_lift_g")
_THESIS = (0.1905, 1.2260, 0.1693)


def conditions_from(args: argparse.Namespace, base: Conditions) -> Conditions:
    """Conditions with the options put on top; an altitude and a pressure exclude each other."""
    given = {name: getattr(args, name) for name in CONDITIONS if getattr(args, name) is not None}
    if {"altitude_m", "pressure_hPa"} <= set(given):
        raise HardwareError("altitude_m and pressure_hPa are both given; allowed: one of them")
    if "pressure_hPa" in given:
        given["altitude_m"] = None
    thermal = set(given) - {"air_kg_m3", "helium_kg_m3", "leak_percent_per_day", "days"}
    if thermal:  # a state that is asked for takes the place of densities that a build brings
        base = replace(base, air_kg_m3=None, helium_kg_m3=None)
    return replace(base, **given)


def buoyancy(args: argparse.Namespace) -> int:
    """Lift of what the options describe; of a build where they describe no envelope."""
    described = [name for name in _GEOMETRY if getattr(args, name) is not None]
    if len(described) > 1 and described != ["volume_m3", "shape"]:
        raise HardwareError(f"{' and '.join(described)} are given; allowed: one of them")
    if described and args.build is not None:
        raise HardwareError(f"{described[0]} and a build are given; allowed: one of them")
    if described:
        return _of_options(args)
    for name in ("diameter_m", "length_m", "width_m"):
        if getattr(args, name) is not None:
            raise HardwareError(f"{name} is given without --shape; allowed: with a shape")
    return _of_build(args)


def _envelope(args: argparse.Namespace) -> Envelope | None:
    """The envelope that is described; None where only volume or free lift are known."""
    if args.shape is None:
        return None
    if args.volume_m3 is not None:
        return of_volume(args.shape, args.volume_m3)
    wanted = ("length_m", "width_m") if args.shape == "ellipsoid" else ("diameter_m",)
    for name in wanted:
        if getattr(args, name) is None:
            raise HardwareError(f"{name} is missing: a {args.shape} needs {' and '.join(wanted)}")
    return of_shape(args.shape, args.length_m or 0, args.width_m or 0, args.diameter_m or 0)


def _of_options(args: argparse.Namespace) -> int:
    _refuse(args, ("solve", "required_g"), "of a build only")
    envelope, day = _envelope(args), conditions_from(args, Conditions())
    masses = {name: getattr(args, name) for name in MASSES if getattr(args, name) is not None}
    if args.film_g_m2 is not None:
        if envelope is None or "envelope_g" in masses:
            raise HardwareError("film_g_m2 is given; allowed: with a shape, without envelope_g")
        masses = {"envelope_g": envelope.film_m2 * args.film_g_m2, **masses}
    if args.free_lift_g is not None:
        _refuse(args, (*CONDITIONS, "film_g_m2", "envelope_g"), "not with a measured free lift")
        lift, note = args.free_lift_g, "measured free lift, the envelope's own weight in it"
        document: dict[str, Any] = {"free_lift_g": lift}
        print(f"{lift:.1f} g  {note}")
    else:
        volume = envelope.volume_m3 if envelope else args.volume_m3
        air, helium = day.densities_kg_m3
        full = gross_lift_g(volume, air, helium)
        lift = full * day.gas_left
        document = {"volume_m3": volume, "air_kg_m3": air, "helium_kg_m3": helium,
                    "conditions": asdict(day), "gross_g": full, "gross_now_g": lift}  # fmt: skip
        print(f"{full:.1f} g gross: {volume:.4f} m³ × ({air:.4f} − {helium:.4f}) kg/m³")
        if (volume, day.air_kg_m3, day.helium_kg_m3) == _THESIS:
            print(
                f"note: the thesis prints {THESIS_GROSS_G} g for this, with units of cm³ and g/cm³;"
            )
            print("      and it is gross lift: envelope, fins, mechanism and payload come off it")
        if day.gas_left < 1:
            print(f"{lift:.1f} g after {day.days:g} days at {day.leak_percent_per_day:g} % a day")
    for name, mass in masses.items():
        print(f"{-mass:.1f} g {name.removesuffix('_g')}")
    if masses:
        margin = lift - sum(masses.values())
        print(f"{margin:+.1f} g margin" + ("" if margin > 0 else ": it does not fly"))
        document |= {"masses": masses, "margin_g": margin}
    _save(args.json, document)
    return 0


def _of_build(args: argparse.Namespace) -> int:
    _refuse(args, ("film_g_m2", *MASSES[:-1]), "a build has its own")
    build = shipped_builds().named(args.build)
    build = replace(build, conditions=conditions_from(args, build.conditions))
    if args.ballast_g is not None:
        build = with_ballast(build, args.ballast_g)
    required = args.required_g or 0.0
    document: dict[str, Any] = {"build": build.name, "gross_g": gross_of(build),
                                "mass_g": build.mass_g, "margin_g": margin_g(build)}  # fmt: skip
    if args.solve == "envelope":
        size = inverse.smallest_envelope(build, required)
        document["envelope"] = asdict(size)
        print(f"{size.volume_m3:.4f} m³: {size.shape}, {size.length_m:.3f} × {size.width_m:.3f}"
              f" × {size.height_m:.3f} m filled, {size.film_m2:.2f} m² of film")  # fmt: skip
    elif args.solve == "battery":
        cell = inverse.most_battery(build, required)
        document["cell"] = {"capacity_mAh": cell.capacity_mAh, "mass_g": cell.mass_g}
        print(
            f"{cell.capacity_mAh:.0f} mAh, {cell.mass_g:.1f} g: the cell that leaves {required:g} g"
        )
    elif args.solve == "ballast":
        ballast = inverse.ballast_to_neutral(build) - required
        document["ballast_g"] = checked("ballast_g", ballast)
        print(f"{ballast:.1f} g of ballast in all leave {required:g} g")
    else:
        print(f"{gross_of(build):.1f} g gross lift of build {build.name}")
        print(f"{-build.mass_g:.1f} g all that flies")
        print(f"{margin_g(build):+.1f} g margin" + ("" if margin_g(build) > 0 else ": too heavy"))
    _save(args.json, document)
    return 0


def endurance(args: argparse.Namespace) -> int:
    """Minutes by mode; 1 when the cell cannot give the current of streaming."""
    build = shipped_builds().named(args.build)
    wear = Wear(**{n: getattr(args, n) for n in WEAR if getattr(args, n) is not None})
    if args.capacity_mAh is not None:
        build = inverse.with_cell(build, inverse.cell_of(build, args.capacity_mAh))
    table, flights = tables.endurance_table(build, wear)
    cell = inverse.payload_cell(build)
    print(f"{build.name}: {cell.name}, {cell.capacity_mAh:g} mAh, {wear.health_percent:g} % of it"
          f" left, down to {wear.cutoff_V:g} V or {wear.reserve_percent:g} %,"
          f" at {wear.temperature_C:g} °C")  # fmt: skip
    print(table.text())
    for flight in flights:
        if flight.verdict == "warn":
            print(f"warning: {flight.mode} takes {flight.end_A:.2f} A of {flight.rating_A:g} A")
        elif flight.verdict in ("refuse", "none"):
            why = "no minute" if flight.verdict == "none" else f"{flight.end_A:.2f} A"
            print(f"refused: {flight.mode}: {why}; allowed: {flight.rating_A:g} A")
    _save(args.json, {"build": build.name, "wear": asdict(wear),
                      "modes": [asdict(flight) for flight in flights]})  # fmt: skip
    bad = [f for f in flights if f.mode == "stream" and f.verdict in ("refuse", "none")]
    return 1 if bad else 0


def budget(args: argparse.Namespace) -> int:
    """The whole budget of one build; 1 when its margin is not positive."""
    build = shipped_builds().named(args.build)
    if args.out is not None:
        output.make_folder(args.out)  # refused before anything is computed
    margin = margin_of(build)
    endurance_table, flights = tables.endurance_table(build, Wear())
    text = "\n\n".join([
        f"{build.name}: {build.about}", tables.mass_budget(build, margin).text(),
        f"90 % of such builds and days have {margin.low_g:+.0f} to {margin.high_g:+.0f} g;"
        f" {100 * margin.positive_share:.1f} % fly",
        endurance_table.text(), tables.answers(build).text(),
    ])  # fmt: skip
    print(text)
    document = {"build": build.name, "margin": asdict(margin),
                "items": [asdict(item) for item in build.items],
                "endurance": [asdict(flight) for flight in flights]}  # fmt: skip
    if args.out is not None:
        from hw import plots

        output.write_text(args.out / "budget.txt", text + "\n")
        output.write_json(args.out / "budget.json", document)
        for path in plots.draw(build, margin, Wear(), args.out):
            print(path)
    if args.write_readme:
        for path in tables.write_readme():
            print(path)
    _save(args.json, document)
    if margin.margin_g > 0:
        return 0
    print(f"the margin is {margin.margin_g:+.1f} g; it must be above 0", file=sys.stderr)
    return 1


def wiring(args: argparse.Namespace) -> int:
    from hw import wiring as drawn

    gauge, autopilot = drawn.variant_of(shipped_builds().named(args.build))
    text = drawn.drawing(gauge, autopilot)
    if args.out is None:
        print(text, end="")
    else:
        output.write_text(args.out, text)
        print(args.out)
    wires = [wire.ends for wire in drawn.load_wiring(gauge, autopilot).wires]
    _save(args.json, {"gauge": gauge, "autopilot": autopilot, "wires": wires})
    return 0


def _refuse(args: argparse.Namespace, names: tuple[str, ...], why: str) -> None:
    for name in names:
        if getattr(args, name) is not None:
            raise HardwareError(f"{name} is given; allowed: {why}")


def _save(path: Path | None, document: dict[str, Any]) -> None:
    if path is not None:
        output.write_json(path, document)
