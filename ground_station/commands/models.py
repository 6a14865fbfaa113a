"""`blimp models`: models of users, and the training of our own."""

from __future__ import annotations

import argparse

from ground_station.feature_models import command as models
from ground_station.training import command as training

_TRAIN_HELP = "train the networks that ship"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the sub-commands to the parser of `blimp models`."""
    commands = parser.add_subparsers(dest="models_command", required=True, metavar="COMMAND")
    models.add_arguments(commands)
    train = commands.add_parser(
        "train",
        help=_TRAIN_HELP,
        description=_TRAIN_HELP[0].upper() + _TRAIN_HELP[1:] + ".",
    )
    training.add_arguments(train)


def run(args: argparse.Namespace) -> int:
    """Runs one of them; returns the exit status."""
    room = training if args.models_command == "train" else models
    return int(room.run(args))
