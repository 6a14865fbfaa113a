"""`python -m hw`: what it is asked and what it prints."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NoReturn

from hw.quantities import RANGES, HardwareError, checked, unit_of

CONDITIONS = ("temperature_C", "pressure_hPa", "altitude_m", "humidity_percent",
               "purity_percent", "superpressure_Pa", "leak_percent_per_day", "days",
               "air_kg_m3", "helium_kg_m3")  # fmt: skip
MASSES = ("envelope_g", "fins_g", "mechanism_g", "payload_g", "ballast_g")
WEAR = ("health_percent", "cutoff_V", "reserve_percent", "temperature_C")


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, and names the option whose unit was left out."""

    def error(self, message: str) -> NoReturn:
        unknown = message.partition("unrecognized arguments: ")[2].split()
        for word in unknown[:1]:
            stem = word.partition("=")[0]
            meant = [o for o in _all_options(self) if o.startswith(stem + "-")]
            if stem.startswith("--") and meant:
                message = f"{stem} has no unit; allowed: {', '.join(sorted(set(meant)))}"
        self.exit(2, f"{self.prog}: {message}\n")


def _all_options(parser: argparse.ArgumentParser) -> list[str]:
    found: list[str] = []
    for action in parser._actions:
        found += action.option_strings
        if isinstance(action, argparse._SubParsersAction):
            for sub in action.choices.values():
                found += _all_options(sub)
    return found


def _quantity(name: str) -> Callable[[str], float]:
    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            unit = unit_of(name) or "1"
            raise argparse.ArgumentTypeError(
                f"{name} is {text!r}; allowed: a number, the unit {unit} stands in the option"
            ) from None
        try:
            return checked(name, value)
        except HardwareError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    return read


def _add(parser: argparse.ArgumentParser, names: Sequence[str]) -> None:
    for name in names:
        low, high = RANGES[name]
        unit = unit_of(name)
        parser.add_argument(
            "--" + name.lower().replace("_", "-"), dest=name, type=_quantity(name),
            metavar="X", help=f"{low:g} to {high:g}{' ' + unit if unit else ''}".replace("%", "%%"),
        )  # fmt: skip


def parser() -> argparse.ArgumentParser:
    result = _Parser(
        prog="python -m hw", description="The payload's lift, margin, endurance and wiring.",
        allow_abbrev=False,
        epilog="Example: python -m hw buoyancy --volume-m3 0.1905 --temperature-c 20",
    )  # fmt: skip
    commands = result.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(name: str, text: str, example: str) -> argparse.ArgumentParser:
        sub = commands.add_parser(
            name, help=text, description=text[0].upper() + text[1:] + ".", allow_abbrev=False,
            epilog=f"Example: python -m hw {example}",
        )  # fmt: skip
        sub.add_argument("--build", metavar="NAME", help="of hw/builds.toml (default: its default)")
        sub.add_argument("--json", type=Path, metavar="F", help="also write the numbers")
        return sub

    sub = command("buoyancy", "lift of an envelope, of a measured free lift or of a build",
                  "buoyancy --shape sphere --diameter-m 0.714 --payload-g 60")  # fmt: skip
    _add(sub, ("volume_m3", "diameter_m", "length_m", "width_m", "free_lift_g"))
    sub.add_argument("--shape", help="sphere, pillow (two flat discs) or ellipsoid")
    _add(sub, (*CONDITIONS, "film_g_m2", *MASSES, "required_g"))
    sub.add_argument(
        "--solve", choices=("envelope", "battery", "ballast"),
        help="of a build: the smallest, the most, to neutral; with --required-g of margin left",
    )  # fmt: skip
    sub = command("endurance", "minutes of the payload's cell, by mode",
                  "endurance --health-percent 70")  # fmt: skip
    _add(sub, ("capacity_mAh", *WEAR))
    sub = command("budget", "a build's table and plots; status 1 when its margin is not positive",
                  "budget --out out/budget")  # fmt: skip
    sub.add_argument("--out", type=Path, metavar="DIR", help="folder for table, plots and numbers")
    sub.add_argument("--write-readme", action="store_true", help="renew hw/README.md and drawings")
    sub = command("wiring", "the wiring of a build as SVG", "wiring --out out/wiring.svg")
    sub.add_argument("--out", type=Path, metavar="F.svg", help="file (default: standard output)")
    return result
