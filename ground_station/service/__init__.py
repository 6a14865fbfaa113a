from argparse import ArgumentParser
from pathlib import Path


def add_settings_arguments(parser: ArgumentParser) -> None:
    """Declares the two arguments that `settings.load` takes."""
    parser.add_argument("--config", type=Path, metavar="FILE", help="TOML file (default: defaults)")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="overrides one key"
    )


def add_lan_argument(parser: ArgumentParser) -> None:
    """Declares `--lan`, which `lan.on` takes: None without it, "" without an interface."""
    parser.add_argument(
        "--lan", nargs="?", const="", metavar="INTERFACE",
        help="heard and found by payloads on that network, as wlan0 (default: the only one)",
    )  # fmt: skip
