"""`python -m deploy.flash`: refuse, show, ask, write, read back, customise."""

from __future__ import annotations

import argparse
import contextlib
import signal
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from deploy.board.inputs import SIGNERS
from deploy.errors import DeployError, Interrupted
from deploy.flash import customise, disks, image, keys, wishes, write
from deploy.flash.boot import BootPartition
from deploy.flash.customise import Content
from deploy.flash.write import Target
from deploy.provisioning.model import Provisioning

_INTERRUPTED = 130  # as a shell says it: 128 and SIGINT's number
_EXAMPLE = """example:
  blimp keys init; blimp keys ground main; blimp keys payload blimp-1
  sudo .venv/bin/python -m deploy.flash --device /dev/sdb --image out/image/blimp-zero2w.img \\
      --payload blimp-1 --wifi-ssid hall --country DE
Later, only another network (nothing else is changed):
  sudo .venv/bin/python -m deploy.flash --customise-only --device /dev/sdb --wifi-ssid other \\
      --country DE
"""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m deploy.flash",
        description="Writes a card image to a card, reads it back, and tells it its world.",
        epilog=_EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--device", type=Path, required=True, metavar="DISK|FILE", help="the card, as /dev/sdb")
    add("--image", type=Path, metavar="IMG[.xz]", help="with its .sha256 and .bmap beside it")
    add("--customise-only", action="store_true", help="writes no image; changes what is named")
    add("--payload", metavar="NAME", help="the payload's name, of `blimp keys payload NAME`")
    add("--wifi-ssid", metavar="NAME", help="the network's name; its password is asked for")
    add("--wifi-password-file", type=Path, metavar="F", help="a file with the password instead")
    add("--wifi-security", choices=("wpa2", "wpa3", "open"), help="default: wpa2")
    add("--wifi-hidden", action="store_true", help="the network does not announce its name")
    add("--wifi", type=Path, metavar="FILE", help="a TOML file with the table [wifi] instead")
    add("--no-wifi", action="store_true", help="a payload on a cable")
    add("--country", metavar="CC", help="where the radio is used, as DE")
    add("--ground", metavar="auto|ADDRESS", help="the ground station (default: auto)")
    add("--keys", type=Path, metavar="DIR", help="of `blimp keys` (~/.local/share/blimp/keys)")
    add("--ssh-key", type=Path, action="append", metavar="F",
        help="public key that may log in as pilot (default: the ground stations')")  # fmt: skip
    add("--no-ssh", action="store_true", help="nobody may log in")
    add("--payload-toml", type=Path, metavar="F", help="the firmware's settings, checked by it")
    add("--board", metavar="BOARD", help="refuses an image for another one, as zero2w")
    add("--no-checksum", action="store_true", help="goes on without a .sha256")
    add("--yes", action="store_true", help="does not ask")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the flasher: status 0, 2 on what a person can fix, 130 when interrupted."""
    options = _parser().parse_args(arguments)
    try:
        with _interruptible():
            _run(options)
    except DeployError as error:
        print(f"deploy.flash: {error}", file=sys.stderr)
        return _INTERRUPTED if isinstance(error, Interrupted) else 2
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        print(f"deploy.flash: {where}{error.strerror or error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("deploy.flash: interrupted; nothing was written", file=sys.stderr)
        return _INTERRUPTED
    return 0


def _run(options: argparse.Namespace) -> None:
    device = options.device
    if not options.customise_only:
        _needed(options)
    disk = disks.find(device)
    if options.customise_only:
        with Target.open(device) as target:
            boot = BootPartition.find(target.fileno(), str(device))
            content = _content(options, _stored(options, boot))
            customise.check_room(boot, content)
            _confirm(options, disk, target, "change its settings")
            written = customise.customise(target, boot, content)
            names = ", ".join(path.partition("/")[2] for path in written)
            print(f"{device}: {f'written: {names}' if names else 'all was as asked already'}")
            _done(options, content)
        return
    if device.exists() and options.image.exists() and device.samefile(options.image):
        raise DeployError(f"{device}: the image itself; name a card, or another file")
    with (
        image.opened(options.image, checksum=not options.no_checksum, board=options.board) as card,
        Target.open(device) as target,
    ):
        disks.check_size(device, target.size, card.size)
        content = _content(options, None)
        customise.check_room(card.boot, content)
        print(f"image: {card.path.name}{_of_board(card)}")
        _confirm(options, disk, target, "overwrite all of it")
        boot = BootPartition.at(target.fileno(), card.boot.offset, str(device))
        write.write(card, target, lambda: customise.customise(target, boot, content))
        if not target.reread_table():
            print("the system still has the old partitions: take the card out and put it in again")
    _done(options, content)


def _needed(options: argparse.Namespace) -> None:
    """What a new card must be told; asked for before anything is looked at."""
    for name in ("image", "payload"):
        if getattr(options, name) is None:
            raise DeployError(f"--{name} is missing (--customise-only writes no image)")
    _network_named(options)


def _network_named(options: argparse.Namespace) -> None:
    if options.wifi_ssid is None and options.wifi is None and not options.no_wifi:
        raise DeployError("expected --wifi-ssid, --wifi, or --no-wifi for a payload on a cable")


def _stored(options: argparse.Namespace, boot: BootPartition) -> Provisioning | None:
    """What the card says; all must be named where it says nothing, or nothing that is right."""
    existing = None
    try:
        existing = customise.stored(boot)
    except DeployError as error:
        if options.payload is None:
            raise DeployError(f"{error} (name all again: --payload and Wi-Fi)") from None
        print(f"the card's {error}; it is written again")
    if existing is None:
        if options.payload is None:
            raise DeployError("--payload is missing: the card does not have a name yet")
        _network_named(options)
    return existing


def _content(options: argparse.Namespace, existing: Provisioning | None) -> Content:
    """All that was asked for, checked; the password is asked for last."""
    payload = options.payload or (existing.payload_id if existing else "")
    Provisioning(payload)  # its name, before it is a folder's
    folder = options.keys or wishes.default_keys()
    held = keys.load(folder, payload) if options.payload else None
    if held is not None and SIGNERS not in held.files:
        print(
            f"note: the card will take no updates: {folder} names no key of releases for it;"
            " make one, and set it up again: blimp keys release"
        )
    ssh = _ssh_keys(options, folder, held, existing)
    before = {"no_wifi": options.no_wifi, "ground": options.ground, "ssh": ssh}
    planned = wishes.merge(existing, payload, None, **before)
    settings = None
    if options.payload_toml is not None:  # before a password is typed for nothing
        settings = wishes.read_file(options.payload_toml)
        certificates = folder / "payload" / payload
        there = certificates if held or certificates.is_dir() else None
        customise.check_payload_toml(options.payload_toml, settings, planned, there)
    wifi = wishes.read_wifi(options)
    country = options.country if wifi is None else None
    provisioning = wishes.merge(existing, payload, wifi, country=country, **before)
    return Content(provisioning, held, settings)


def _ssh_keys(
    options: argparse.Namespace,
    folder: Path,
    held: keys.Keys | None,
    existing: Provisioning | None,
) -> tuple[str, ...] | None:
    """Who may log in; None: as it is on the card."""
    if options.no_ssh:
        if options.ssh_key:
            raise DeployError("expected one of --ssh-key and --no-ssh")
        return ()
    if options.ssh_key:
        return tuple(line for file in options.ssh_key for line in keys.read_ssh_key(file))
    if existing is None and held is not None:
        return keys.ground_ssh_keys(folder, held.peers)
    return None


def _confirm(
    options: argparse.Namespace, disk: disks.Entry | None, target: Target, what: str
) -> None:
    """Shows the device and lets its name be typed; raises `DeployError` when it is another one."""
    print(disks.describe(target.path, disk, target.size), flush=True)
    if options.yes:
        return
    name = target.path.name
    try:
        typed = input(f"Type {name} to {what}: ")
    except EOFError:
        print()
        typed = ""
    if typed.strip() != name:
        raise DeployError("not confirmed; nothing was written (--yes does not ask)")


def _of_board(card: image.Image) -> str:
    told = ", ".join(filter(None, (card.board, card.version)))
    return f" ({told})" if told else ""


def _done(options: argparse.Namespace, content: Content) -> None:
    device, provisioning, held = options.device, content.provisioning, content.keys
    wifi, keys_held = provisioning.wifi, len(provisioning.authorized_keys)
    network = "no Wi-Fi"
    if wifi is not None:
        network = f"Wi-Fi {wifi.ssid.decode(errors='replace')!r} in {wifi.country}"
    log_in = f"{keys_held} key{'s' if keys_held > 1 else ''} for SSH" if keys_held else "no SSH"
    print(
        f"{device}: ready for payload {provisioning.payload_id}: {network}, ground station"
        f" {provisioning.ground_station.host}, {log_in}; read back and the same"
    )
    serve = ".venv/bin/blimp serve --lan"
    if held is not None:
        keys.remember(options.keys or wishes.default_keys(), provisioning.payload_id, held)
        if "ground.main" not in held.peers:
            serve += f" --set name={held.peers[0].partition('.')[2]}"
    print("put it into the payload, whose ground station is in the same network")
    print(f"next: {serve}")


@contextlib.contextmanager
def _interruptible() -> Iterator[None]:
    """Ctrl-C, a kill and a closed terminal all end it in order, and one of them once."""
    ending = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

    def stop(*_: object) -> None:
        for number in ending:
            signal.signal(number, signal.SIG_IGN)
        raise KeyboardInterrupt

    before = {number: signal.signal(number, stop) for number in ending}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


if __name__ == "__main__":
    sys.exit(main())
