"""Takes the secrets out of the boot partition once the card has them.

Each file is overwritten in its own blocks, written through, and only then removed. On flash memory
that is all a program can do: the card's controller may keep old cells out of everybody's sight.
Power may go at any point: what is left is recognised (`inputs.py`) and finished at the next boot.
"""

from __future__ import annotations

from pathlib import Path

from deploy.board.card import Card
from deploy.board.disk import Disk
from deploy.board.inputs import CERTIFICATES, FILE, KEPT_FILE, KNOWN


def is_needed(card: Card, kept: bytes) -> bool:
    """Whether anything is left to be taken out."""
    try:
        same = (card.boot / FILE).read_bytes() == kept
    except OSError:
        same = False
    return not same or (card.boot / KEPT_FILE).exists() or (card.boot / CERTIFICATES).exists()


def shred(card: Card, disk: Disk, kept: bytes) -> None:
    """Makes blimp.toml what `kept` says and removes certificates/; raises `OSError`.

    blimp.toml is overwritten with zeros first: a file half zeros is no valid TOML, so that it can't
    be mistaken for one that a person wrote, and the whole lies beside it meanwhile.
    """
    file, beside = card.boot / FILE, card.boot / KEPT_FILE
    if file.read_bytes() != kept:
        disk.write(beside, kept)
        # As long as what comes then: until that is whole there are zeros in it.
        disk.overwrite(file, bytes(max(file.stat().st_size, len(kept))))
        disk.overwrite(file, kept)
    disk.remove(beside)
    _shred_folder(card.boot / CERTIFICATES, disk)


def _shred_folder(folder: Path, disk: Disk) -> None:
    """Those that we know last: a folder that power left half empty still has one of them."""
    if not folder.is_dir():
        return
    ours = {folder / name for name in KNOWN}
    for path in sorted(folder.rglob("*"), key=lambda path: (path in ours, path)):
        if path.is_file() and not path.is_symlink():
            disk.overwrite(path, bytes(path.stat().st_size))
            disk.remove(path)
    disk.remove(folder)
