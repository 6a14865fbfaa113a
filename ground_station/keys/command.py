"""`blimp keys`: the authority's command line."""

from __future__ import annotations

import argparse
import datetime
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from ground_station import user_folders
from ground_station.errors import KeysError

if TYPE_CHECKING:
    from ground_station.keys.authority import Authority

_EXAMPLE = """example:
  blimp keys init
  blimp keys ground main
  blimp keys payload blimp-1     # copy the folder it names to the payload
  blimp keys revoke payload.blimp-1
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.epilog = _EXAMPLE
    parser.add_argument(
        "--folder", type=Path, help="the authority's folder (default: ~/.local/share/blimp/keys)"
    )
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")

    def add(name: str, what: str, after: str) -> argparse.ArgumentParser:
        made = actions.add_parser(name, help=what)
        made.set_defaults(next=after)
        return made

    add("init", "make a new authority", "blimp keys ground main")
    for verb, name, what, after in (
        ("payload", "1 to 32 of a-z, 0-9, - and _", "make the certificate and keys of a payload",
         "make flash DEVICE=/dev/sdX IMAGE=FILE PAYLOAD={name} WIFI=SSID COUNTRY=DE"),
        ("ground", "as a payload's", "make the certificate and keys of a ground station",
         "blimp keys payload blimp-1"),
        ("renew", "payload.ID or ground.NAME", "give a member a new certificate",
         "blimp keys check"),
    ):  # fmt: skip
        signed = add(verb, what, after)
        signed.add_argument("name", help=name)
        signed.add_argument("--days", type=int, default=730, help="valid for, days, 1 to 3650")
    add("list", "who has a certificate, and until when", "blimp keys check")
    add("release", "name the key that signs releases; makes a missing one", "")  # programs read it
    revoke = add("revoke", "take a name out of everyone's access list", "blimp keys list")
    revoke.add_argument("name", help="payload.ID or ground.NAME")
    add("rotate", "go one step of the three that replace the authority", "blimp keys check")
    add("check", "say what is wrong or ends within 30 days; status 1 if any", "blimp serve --lan")


def run(arguments: argparse.Namespace) -> int:
    """Runs one action; raises `BlimpError` with one line."""
    from ground_station.keys.authority import alone

    folder = arguments.folder or user_folders.data() / "keys"
    with alone(folder):
        return _act(arguments, folder)


def _act(arguments: argparse.Namespace, folder: Path) -> int:
    from ground_station.keys.authority import Authority

    action = arguments.action
    if action == "init":
        Authority.create(folder)
        print(f"authority in {folder}: keep a copy of it away from the network")
        return 0
    authority = Authority(folder)
    if action in ("payload", "ground", "renew"):
        if not 1 <= arguments.days <= 3650:
            raise KeysError(f"--days is {arguments.days}; allowed: 1 to 3650")
        if action == "renew":
            print(authority.renew(arguments.name, arguments.days))
            print("copy its folder again, and restart its program")
            return 0
        print(authority.add(action, arguments.name, arguments.days))
        print("the other side's folders list it now: copy them again, and restart its programs")
    elif action == "revoke":
        authority.revoke(arguments.name)
        print(f"{arguments.name} is off all lists: copy the folders again, restart the programs")
    elif action == "rotate":
        print(f"authority: {authority.rotate()}; copy all folders before the next step")
    elif action == "release":
        path, made = authority.release_key()
        if made:
            print(
                f"{path} is new: copy the payloads' folders to their cards again", file=sys.stderr
            )
        print(path)
    elif action == "list":
        _list(authority)
    else:
        problems = authority.check(datetime.datetime.now(datetime.UTC))
        print("\n".join(problems) or "all certificates and lists are good")
        return 1 if problems else 0
    return 0


def _list(authority: Authority) -> None:
    from ground_station.keys.authority import STEPS, inspect

    print(f"authority {authority.signing}: {STEPS[authority.step]}")
    for name, entry in sorted(authority.members.items()):
        state = "revoked"
        if not entry["revoked"]:
            try:
                _, until = inspect(authority.of(name))
                state = f"until {until:%Y-%m-%d}"
            except (KeysError, OSError) as error:
                state = str(error)
        print(f"{name}  {state}")
