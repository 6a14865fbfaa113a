"""The image, the keys and the bench of the flasher's tests."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path

import pytest
from card_bench import MEBI, SYSTEM_PATH, TOOLS, Bench, make_image, sum_of, tool


@pytest.fixture(scope="session")
def shared_image(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The image that tests copy; with a map by bmap-tools, which leaves its gap out."""
    if missing := [name for name in TOOLS if shutil.which(name, path=SYSTEM_PATH) is None]:
        pytest.skip(f"not on this machine: {', '.join(missing)}")
    image = tmp_path_factory.mktemp("image") / "blimp-test.img"
    make_image(image)
    tool("bmaptool", "create", "-o", f"{image}.bmap", str(image))
    sum_of(image)
    manifest = {"schema": "blimp.image/1", "board": "zero2w", "version": "0.1.0+gitabcdef"}
    Path(f"{image}.manifest.json").write_text(json.dumps(manifest))
    return image


@pytest.fixture(scope="session")
def shared_keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An authority with a ground station and two payloads, as `blimp keys` makes it."""
    from ground_station.keys.authority import Authority

    folder = tmp_path_factory.mktemp("keys") / "keys"
    authority = Authority.create(folder)
    authority.add("ground", "main")
    for name in ("blimp-1", "blimp-2"):
        authority.add("payload", name)
    return folder


@pytest.fixture
def bench(tmp_path: Path, shared_image: Path, shared_keys: Path) -> Bench:
    """A bench of the test's own; the card holds another card's remains."""
    image = tmp_path / shared_image.name
    tool("cp", "--sparse=auto", str(shared_image), str(image))
    for suffix in (".bmap", ".sha256", ".manifest.json"):
        shutil.copy(f"{shared_image}{suffix}", f"{image}{suffix}")
    card = tmp_path / "card"
    card.write_bytes(hashlib.shake_256(b"old").digest(MEBI) * (image.stat().st_size // MEBI + 3))
    return Bench(tmp_path, image, card, shared_keys)
