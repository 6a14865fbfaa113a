"""What a board's card is made of, as data: `deploy/image/boards/NAME.toml`.

`include` names files beside it whose lists come before the board's own.
"""

from __future__ import annotations

import dataclasses
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from deploy.errors import DeployError

BOARDS_FOLDER = Path(__file__).parents[1] / "boards"

_NAME = re.compile(r"[a-z0-9][a-z0-9+.-]*")


@dataclass(frozen=True)
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

    name: str
    url: str
    suites: tuple[str, ...]
    components: tuple[str, ...]
    keyring: str
    origin: str
    only: tuple[str, ...] = ()


@dataclass(frozen=True)
class Group:
    """Packages, or patterns of paths, that stand there for one reason.

    Of path patterns, one that starts with `!` takes back what one before it left out.
    """

    reason: str
    names: tuple[str, ...]


@dataclass(frozen=True)
class KernelChoice:
    """The kernel's packages and what of them goes onto the card.

    Attributes:
        package: the kernel, or the package that depends on the present one.
        image: what the kernel's file is called on the boot partition.
        firmware: packages whose files the board's first stage loads; empty for an emulated one.
        dtbs, overlays: patterns of the device trees and overlays to take.
        modules: names of the modules to take, with what they depend on; empty: all.
    """

    package: str
    image: str
    firmware: tuple[str, ...]
    dtbs: tuple[str, ...]
    overlays: tuple[str, ...]
    modules: tuple[str, ...]


@dataclass(frozen=True)
class Wheel:
    """A distribution of `requirements.lock` that Debian has no package of.

    Attributes:
        name: as in the lock.
        keep: patterns of the paths to unpack; empty: all.
        portable: only its pure Python is taken, from a wheel of whatever platform.
    """

    name: str
    keep: tuple[str, ...] = ()
    portable: bool = False


@dataclass(frozen=True)
class Board:
    """A board and everything of others that its card holds.

    Attributes:
        name: as in `BOARD=`.
        title: for a person.
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

    name: str
    title: str
    architecture: str
    machine: str
    suite: str
    python: str
    base: str
    archives: tuple[Archive, ...]
    packages: tuple[Group, ...]
    left_out: tuple[Group, ...]
    kernel: KernelChoice | None
    platforms: tuple[str, ...]
    wheels: tuple[Wheel, ...]

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
    parts = document.pop("include", [])
    if not isinstance(parts, list) or not all(isinstance(part, str) for part in parts):
        raise DeployError(f"{path}: include: is a list of files beside it")
    for part in parts:
        for key, items in _document(path.parent / part).items():
            document[key] = [*items, *document.get(key, [])]
    return _Reader(path, document).board()


def with_archives(board: Board, changes: Mapping[str, Mapping[str, str]]) -> Board:
    """The board with archives at other places.

    Args:
        changes: by the archive's name, any of `url`, `keyring` and `origin`.

    Raises:
        DeployError: the board has no archive of that name, or the archive no such property.
    """
    names = [archive.name for archive in board.archives]
    for name, change in changes.items():
        if name not in names:
            there = f"there are {', '.join(names)}" if names else "it has none"
            raise DeployError(f"board {board.name} has no archive {name!r}: {there}")
        for key in change:
            if key not in ("url", "keyring", "origin"):
                raise DeployError(f"archive {name}: {key!r} is none of url, keyring, origin")
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


class _Reader:
    """Turns a board's document into its record, and names what is wrong in it."""

    def __init__(self, path: Path, document: dict[str, Any]) -> None:
        self._path, self._document = path, document

    def board(self) -> Board:
        top = self._table(
            self._document,
            "",
            texts=("title", "architecture", "machine", "suite", "python"),
            optional_texts=("base",),
            lists=("platforms",),
            tables=("archives", "packages", "left_out", "kernel", "wheels"),
        )
        kernel = self._document.get("kernel")
        if (kernel is None) == (not top["base"]):
            raise self._wrong("kernel", "stands exactly where no base image brings one")
        return Board(
            name=self._path.stem,
            archives=tuple(self._archive(*item) for item in self._items("archives")),
            packages=tuple(self._group(*item, package=True) for item in self._items("packages")),
            left_out=tuple(self._group(*item, package=False) for item in self._items("left_out")),
            kernel=None if kernel is None else self._kernel(kernel),
            wheels=tuple(self._wheel(*item) for item in self._items("wheels")),
            **top,
        )

    def _archive(self, item: Any, where: str) -> Archive:
        texts = ("name", "keyring", "origin")
        return Archive(
            **self._table(
                item,
                where,
                texts=texts,
                optional_texts=("url",),
                lists=("suites", "components"),
                optional_lists=("only",),
            )
        )

    def _group(self, item: Any, where: str, *, package: bool) -> Group:
        group = Group(**self._table(item, where, texts=("reason",), lists=("names",)))
        for name in group.names:
            if package and not _NAME.fullmatch(name):
                raise self._wrong(f"{where}.names", f"{name!r} is no package's name")
            if not package and not name.removeprefix("!").startswith("/"):
                raise self._wrong(f"{where}.names", f"{name!r} is no absolute path")
        return group

    def _kernel(self, item: Any) -> KernelChoice:
        lists = ("dtbs",)
        optional = ("firmware", "overlays", "modules")
        texts = ("package", "image")
        return KernelChoice(
            **self._table(item, "kernel", texts=texts, lists=lists, optional_lists=optional)
        )

    def _wheel(self, item: Any, where: str) -> Wheel:
        portable = item.pop("portable", False) if isinstance(item, dict) else False
        if not isinstance(portable, bool):
            raise self._wrong(f"{where}.portable", "is true or false")
        values = self._table(item, where, texts=("name",), optional_lists=("keep",))
        return Wheel(portable=portable, **values)

    def _items(self, key: str) -> list[tuple[Any, str]]:
        items = self._document.get(key, [])
        if not isinstance(items, list):
            raise self._wrong(key, f"is written as [[{key}]]")
        return [(item, f"{key}[{index}]") for index, item in enumerate(items)]

    def _table(
        self,
        item: Any,
        where: str,
        *,
        texts: tuple[str, ...] = (),
        optional_texts: tuple[str, ...] = (),
        lists: tuple[str, ...] = (),
        optional_lists: tuple[str, ...] = (),
        tables: tuple[str, ...] = (),
    ) -> dict[str, Any]:
        if not isinstance(item, dict):
            raise self._wrong(where, "is a table")
        prefix = f"{where}." if where else ""
        known = (*texts, *optional_texts, *lists, *optional_lists)
        for key in item:
            if key not in (*known, *tables):
                raise self._wrong(f"{prefix}{key}", f"unknown; there are {', '.join(known)}")
        values: dict[str, Any] = {}
        for key in (*texts, *optional_texts):
            value = item.get(key, "" if key in optional_texts else None)
            if not isinstance(value, str) or (key in texts and not value):
                raise self._wrong(f"{prefix}{key}", "is a text")
            values[key] = value
        for key in (*lists, *optional_lists):
            value = item.get(key, [] if key in optional_lists else None)
            if not isinstance(value, list) or not all(isinstance(v, str) and v for v in value):
                raise self._wrong(f"{prefix}{key}", "is a list of texts")
            if key in lists and not value:
                raise self._wrong(f"{prefix}{key}", "is empty")
            values[key] = tuple(value)
        return values

    def _wrong(self, key: str, what: str) -> DeployError:
        return DeployError(f"{self._path}: {key}: {what}")
