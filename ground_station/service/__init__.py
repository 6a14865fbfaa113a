from argparse import ArgumentParser
from pathlib import Path


def add_settings_arguments(parser: ArgumentParser) -> None:
    """Declares the two arguments that `settings.load` takes."""
    parser.add_argument("--config", type=Path, metavar="FILE", help="TOML file (default: defaults)")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="overrides one key"
    )
