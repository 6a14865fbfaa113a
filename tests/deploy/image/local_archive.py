"""A small signed archive of packages, made by the test: what stands in for those out of reach."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from deploy.image.packages.board import Archive
from deploy.run import find

TOOLS = ("apt-get", "dpkg-deb", "gpg")
_DATE = "Thu, 01 Jan 2026 00:00:00 UTC"


def need_tools(*tools: str) -> None:
    """Skips the test where one of the system's tools is missing."""
    missing = [tool for tool in tools if find(tool) is None]
    if missing:
        pytest.skip(f"needs {', '.join(missing)}")


@dataclass(frozen=True)
class Key:
    """A signing key with a home of its own."""

    home: Path
    public: Path

    def sign(self, text: Path) -> bytes:
        """The file, signed in clear as an archive's InRelease is."""
        return self._gpg("--clearsign", "--output", "-", str(text))

    def _gpg(self, *words: str) -> bytes:
        command = ["gpg", "--batch", "--quiet", "--homedir", str(self.home), *words]
        return subprocess.run(command, check=True, capture_output=True).stdout


@contextmanager
def new_key(folder: Path, name: str) -> Iterator[Key]:
    """A fresh Ed25519 key; its home lies where gpg's socket finds room in a path of 108 bytes."""
    home = Path(tempfile.mkdtemp(prefix="blimp-gpg-", dir="/tmp"))
    try:
        key = Key(home, folder / f"{name}.gpg")
        key._gpg("--passphrase", "", "--quick-gen-key", f"{name} <a@example.org>", "ed25519",
                 "sign", "never")  # fmt: skip
        key.public.write_bytes(key._gpg("--export"))
        yield key
    finally:
        subprocess.run(["gpgconf", "--homedir", str(home), "--kill", "all"], check=False)
        shutil.rmtree(home, ignore_errors=True)


class LocalArchive:
    """An archive in a folder, reached by `file:`."""

    def __init__(self, folder: Path, origin: str, architecture: str = "arm64") -> None:
        self.folder, self.origin, self._architecture = folder, origin, architecture
        (folder / "pool").mkdir(parents=True)

    def add(
        self,
        name: str,
        version: str,
        files: Mapping[str, bytes] | None = None,
        depends: str = "",
        conflicts: str = "",
        postinst: str = "",
    ) -> Path:
        """Puts a package into the pool; `postinst` is the shell script that dpkg runs after it."""
        tree = self.folder / "trees" / f"{name}_{version.replace(':', '%')}"
        (tree / "DEBIAN").mkdir(parents=True)
        control = f"Package: {name}\nVersion: {version}\nArchitecture: {self._architecture}\n"
        control += f"Maintainer: A <a@example.org>\nDescription: for a test\n"  # noqa: F541
        control += f"Depends: {depends}\n" if depends else ""
        control += f"Conflicts: {conflicts}\nReplaces: {conflicts}\n" if conflicts else ""
        (tree / "DEBIAN/control").write_text(control)
        if postinst:
            (tree / "DEBIAN/postinst").write_text(f"#!/bin/sh\nset -e\n{postinst}\n")
            (tree / "DEBIAN/postinst").chmod(0o755)
        for path, data in (files or {}).items():
            (tree / path).parent.mkdir(parents=True, exist_ok=True)
            (tree / path).write_bytes(data)
        deb = self.folder / "pool" / f"{tree.name}.deb"
        words = ["dpkg-deb", "--root-owner-group", "-Znone", "--build", str(tree), str(deb)]
        subprocess.run(words, check=True, capture_output=True)
        return deb

    def publish(self, key: Key | None) -> None:
        """Writes the index, signed by `key`; None: unsigned."""
        stanzas = []
        for deb in sorted((self.folder / "pool").glob("*.deb")):
            field = ["dpkg-deb", "--field", str(deb)]
            control = subprocess.run(field, check=True, capture_output=True, text=True).stdout
            data = deb.read_bytes()
            stanzas.append(
                f"{control.rstrip()}\nFilename: pool/{deb.name}\nSize: {len(data)}\n"
                f"SHA256: {hashlib.sha256(data).hexdigest()}\n"
            )
        index = f"main/binary-{self._architecture}/Packages"
        suite = self.folder / "dists/trixie"
        (suite / index).parent.mkdir(parents=True, exist_ok=True)
        packages = "\n".join(stanzas).encode()
        (suite / index).write_bytes(packages)
        release = suite / "Release"
        release.write_text(
            f"Origin: {self.origin}\nLabel: {self.origin}\nSuite: stable\nCodename: trixie\n"
            f"Date: {_DATE}\nArchitectures: {self._architecture}\nComponents: main\nSHA256:\n"
            f" {hashlib.sha256(packages).hexdigest()} {len(packages)} {index}\n"
        )
        (suite / "InRelease").unlink(missing_ok=True)
        if key is not None:
            (suite / "InRelease").write_bytes(key.sign(release))

    def archive(self, name: str, key: Key, only: tuple[str, ...] = ()) -> Archive:
        """The record that a board names it by."""
        url = f"file:{os.fspath(self.folder)}"
        url = url.replace("file:/", "file:///", 1)
        return Archive(name, url, ("trixie",), ("main",), str(key.public), self.origin, only)
