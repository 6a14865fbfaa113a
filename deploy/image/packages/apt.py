"""apt with a configuration of its own: a board's archives and keys, nothing of this system's.

What it downloads is signed: apt checks each archive's index against that archive's keyring and
each package against the index; beyond that, an index must be of the archive that the board means,
since the pins go by the name it calls itself.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from deploy.errors import DeployError
from deploy.image.packages.board import Archive, Board
from deploy.run import run

_PIN_WINS, _PIN_NEVER = 990, -1
_NETWORK_TRIES, _NETWORK_LIMIT_S = 3, 60
# How any apt of a build behaves, ours or a base image's: nothing unasked, nothing unsigned.
SETTINGS = (
    'APT::Install-Recommends "false";\n'
    'APT::Sandbox::User "root";\n'
    'APT::Update::Error-Mode "any";\n'
    f'Acquire::Retries "{_NETWORK_TRIES}";\n'
    f'Acquire::http::Timeout "{_NETWORK_LIMIT_S}";\n'
    f'Acquire::https::Timeout "{_NETWORK_LIMIT_S}";\n'
    'Acquire::Languages "none";\n'
    'Acquire::AllowInsecureRepositories "false";\n'
    'Acquire::AllowDowngradeToInsecureRepositories "false";\n'
)


def sources(archives: Sequence[Archive]) -> str:
    """The archives as deb822 sources (sources.list(5)), each with its own keys only.

    Raises `DeployError` for an archive without address or without keys.
    """
    stanzas = []
    for archive in archives:
        if not archive.url:
            raise DeployError(
                f"archive {archive.name}: has no address here; give --archive {archive.name}=URL"
            )
        if re.search(r"\s", archive.url) or "://" not in archive.url:
            raise DeployError(f"archive {archive.name}: {archive.url!r} is no URL")
        keyring = Path(archive.keyring).absolute()
        if not keyring.is_file():
            raise DeployError(
                f"archive {archive.name}: keyring {keyring} is not there: install {keyring.stem}; "
                "without such a package, take it from the archive's own pool, unpack "
                f"it (dpkg -x) and give its file: --keyring {archive.name}=FILE"
            )
        stanzas.append(
            f"Types: deb\nURIs: {archive.url}\nSuites: {' '.join(archive.suites)}\n"
            f"Components: {' '.join(archive.components)}\nSigned-By: {keyring}\n"
        )
    return "\n".join(stanzas)


def preferences(archives: Sequence[Archive]) -> str:
    """Pins (apt_preferences(5)): where `only` is given, that and nothing else of the archive."""
    stanzas = []
    for archive in archives:
        if archive.only:
            pin = f"Pin: release o={archive.origin}"
            names = " ".join(archive.only)
            stanzas.append(f"Package: {names}\n{pin}\nPin-Priority: {_PIN_WINS}\n")
            stanzas.append(f"Package: *\n{pin}\nPin-Priority: {_PIN_NEVER}\n")
    return "\n".join(stanzas)


class Apt:
    """Downloads for a board; `opened` makes one."""

    def __init__(self, root: Path, board: Board) -> None:
        self._root, self._board = root, board
        etc = root / "etc/apt"
        for folder in ("apt.conf.d", "preferences.d", "sources.list.d", "trusted.gpg.d"):
            (etc / folder).mkdir(parents=True)
        for folder in ("var/lib/apt/lists/partial", "var/cache/apt/archives/partial"):
            (root / folder).mkdir(parents=True)
        (root / "var/lib/dpkg").mkdir(parents=True)
        (root / "var/lib/dpkg/status").touch()
        (etc / "sources.list.d/board.sources").write_text(sources(board.archives))
        (etc / "preferences.d/board.pref").write_text(preferences(board.archives))
        # Read before anything of the system's, and pointing everything away from it.
        self._configuration = root / "apt.conf"
        self._configuration.write_text(
            f'Dir "{root}";\n'
            f'Dir::Etc "{etc}";\n'
            f'Dir::State::status "{root}/var/lib/dpkg/status";\n'
            f'APT::Architecture "{board.architecture}";\n'
            f'APT::Architectures {{ "{board.architecture}"; }};\n{SETTINGS}'
        )

    def update(self) -> None:
        """Fetches the archives' indexes.

        Raises `DeployError` for one out of reach, unsigned, signed by another, or of another
        origin than the board means.
        """
        try:
            self._run("apt-get", "update", "-q")
        except DeployError as error:
            raise DeployError(
                f"board {self._board.name}: an archive was refused: {error}"
            ) from None
        lines = self._run(
            "apt-get",
            "indextargets",
            "--format",
            "$(REPO_URI)\t$(ORIGIN)",
            "Created-By: Packages",
        ).splitlines()
        origins: dict[str, set[str]] = {}
        for line in lines:
            uri, _, origin = line.partition("\t")
            origins.setdefault(_same(uri), set()).add(origin)
        for archive in self._board.archives:
            found = origins.get(_same(archive.url), set())
            if not found:
                raise DeployError(
                    f"archive {archive.name}: has nothing for {self._board.architecture}"
                )
            for origin in sorted(found - {archive.origin}):
                raise DeployError(
                    f"archive {archive.name}: its index calls itself {origin!r}, "
                    f"{archive.origin!r} was expected"
                )

    def plan(self, names: Sequence[str]) -> str:
        """What installing `names` into an empty system would do, in apt's words."""
        return self._run("apt-get", "install", "--simulate", "-q", *names)

    def dependency(self, name: str, pattern: str) -> str:
        """The package itself, or the one dependency of it whose name matches `pattern` whole."""
        if re.fullmatch(pattern, name):
            return name
        try:
            text = self._run("apt-cache", "depends", "--important", name)
        except DeployError as error:
            raise DeployError(f"package {name}: {error}") from None
        found = sorted(set(re.findall(rf"Depends: ({pattern})$", text, re.MULTILINE)))
        if len(found) != 1:
            raise DeployError(f"package {name}: depends on {len(found)} packages like {pattern!r}")
        return str(found[0])

    def download(self, names: Sequence[str], folder: Path) -> list[Path]:
        """The packages' files, each checked against the signed index, in `folder`, sorted."""
        folder.mkdir(parents=True, exist_ok=True)
        before = set(folder.glob("*.deb"))
        self._run("apt-get", "download", "-q", *names, cwd=folder)
        found = sorted(set(folder.glob("*.deb")) - before)
        if len(found) != len(set(names)):
            raise DeployError(f"{len(found)} of {len(set(names))} packages came: {' '.join(names)}")
        return found

    def _run(self, *words: str, cwd: Path | None = None) -> str:
        return run(words, env={"APT_CONFIG": str(self._configuration)}, cwd=cwd).decode()


def _same(url: str) -> str:
    """A URL as apt writes it back."""
    return re.sub(r"^(file|copy):/+", r"\1:/", url).rstrip("/")


@contextmanager
def opened(board: Board) -> Iterator[Apt]:
    """A private apt with fresh, verified indexes, gone afterwards."""
    with tempfile.TemporaryDirectory(prefix="blimp-apt-", ignore_cleanup_errors=True) as root:
        apt = Apt(Path(root), board)
        apt.update()
        yield apt
