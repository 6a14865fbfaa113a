"""What a board's card is made of, as data: `deploy/image/boards/NAME.toml`.

`include` names files beside it whose lists come before the board's own.
"""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field, ValidationError
from pydantic.dataclasses import dataclass

from deploy.errors import DeployError

BOARDS_FOLDER = Path(__file__).parents[1] / "boards"

_KEYS = ConfigDict(extra="forbid")

Text = Annotated[str, Field(min_length=1)]
Texts = Annotated[tuple[Text, ...], Field(min_length=1)]


@dataclass(frozen=True, config=_KEYS)
class Archive:
    """A signed archive of packages.

    Attributes:
        name: how `--archive NAME=URL` calls it.
        url: its address; empty where the user must give it.
        suites, components: as in sources.list.
        keyring: the public keys that its index must be signed with.
        origin: what its signed index must call itself, and what `only` is pinned by.
        only: name patterns of the packages that may come from it, which it then wins; empty: any.
    """

    name: Text
    url: str
    suites: Texts
    components: Texts
    keyring: Text
    origin: Text
    only: tuple[Text, ...] = ()


@dataclass(frozen=True, config=_KEYS)
class Group:
    """Packages, or patterns of paths, that stand there for one reason.

    Of path patterns, one that starts with `!` takes back what one before it left out.
    """

    reason: Text
    names: Texts


@dataclass(frozen=True, config=_KEYS)
class KernelChoice:
    """The kernel's packages and what of them goes onto the card.

    Attributes:
        package: the kernel, or the package that depends on the present one.
        image: what the kernel's file is called on the boot partition.
        firmware: packages whose files the board's first stage loads; empty for an emulated one.
        dtbs, overlays: patterns of the device trees and overlays to take.
        modules: names of the modules to take, with what they depend on; empty: all.
    """

    package: Text
    image: Text
    dtbs: Texts
    firmware: tuple[Text, ...] = ()
    overlays: tuple[Text, ...] = ()
    modules: tuple[Text, ...] = ()


@dataclass(frozen=True, config=_KEYS)
class Wheel:
    """A distribution of `requirements.lock` that Debian has no package of.

    Attributes:
        name: as in the lock.
        keep: patterns of the paths to unpack; empty: all.
        portable: only its pure Python is taken, from a wheel of whatever platform.
    """

    name: Text
    keep: tuple[Text, ...] = ()
    portable: bool = False


@dataclass(frozen=True, config=_KEYS)
class Board:
    """A board and everything of others that its card holds.

    Attributes:
        name: as in `BOARD=`.
        architecture: Debian's name of it.
        machine: what `uname -m` says there; the tag of its releases.
        suite: Debian's release.
        python: that release's Python, as `3.13`.
        base: what image the user names that the card is made from; empty: none, packages alone.
        archives: in falling order of preference among equals.
        packages: with the reason of each group.
        left_out: path patterns that dpkg doesn't unpack, with reasons.
        kernel: None where the base image brings it.
        platforms: tags of the wheels that run on it, best first.
        wheels: what is taken from the lock.
    """

    name: Text
    architecture: Text
    machine: Text
    suite: Text
    python: Text
    platforms: Texts
    base: str = ""
    archives: tuple[Archive, ...] = ()
    packages: tuple[Group, ...] = ()
    left_out: tuple[Group, ...] = ()
    kernel: KernelChoice | None = None
    wheels: tuple[Wheel, ...] = ()

    def __post_init__(self) -> None:
        if (self.kernel is None) == (not self.base):
            raise ValueError("'kernel' stands exactly where no base image brings one")

    @property
    def package_names(self) -> tuple[str, ...]:
        """Every package that is asked for, once, sorted."""
        return tuple(sorted({name for group in self.packages for name in group.names}))


def load_board(name: str | Path) -> Board:
    """A board by its name, or from a TOML file of one's own.

    Raises:
        DeployError: no such board, or a key that is unknown, missing or of another kind.
    """
    path = Path(name)
    if path.suffix != ".toml":
        path = BOARDS_FOLDER / f"{name}.toml"
        known = sorted(file.stem for file in BOARDS_FOLDER.glob("*.toml"))
        if str(name) not in known:
            raise DeployError(f"board {name}: there are {', '.join(known)}")
    document = _document(path)
    for part in document.pop("include", []):
        for key, items in _document(path.parent / part).items():
            document[key] = [*items, *document.get(key, [])]
    try:
        return Board(**document, name=path.stem)
    except ValidationError as error:
        raise DeployError(f"{path}: {_first(error)}") from None


def with_archives(board: Board, changes: Mapping[str, Mapping[str, str]]) -> Board:
    """The board with archives at other places: `url` and `keyring`, by the archive's name.

    Raises `DeployError` when the board has no archive of that name.
    """
    names = [archive.name for archive in board.archives]
    for name in changes:
        if name not in names:
            there = f"there are {', '.join(names)}" if names else "it has none"
            raise DeployError(f"board {board.name} has no archive {name!r}: {there}")
    archives = tuple(
        dataclasses.replace(archive, **dict[str, Any](changes.get(archive.name, {})))
        for archive in board.archives
    )
    return dataclasses.replace(board, archives=archives)


def _document(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            return tomllib.load(file)
    except OSError as error:
        raise DeployError(f"{path}: {error.strerror or error}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise DeployError(f"{path}: {error}") from None


def _first(error: ValidationError) -> str:
    """The first thing that is wrong, with its key."""
    first = error.errors()[0]
    key = ".".join(map(str, first["loc"]))
    return f"{key}: {first['msg']}" if key else first["msg"].removeprefix("Value error, ")
