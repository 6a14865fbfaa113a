"""What is given to others of an image: whole, signed, and listed for Raspberry Pi Imager."""

from __future__ import annotations

import hashlib
import json
import lzma
import shutil
import subprocess
from pathlib import Path

import pytest

from deploy import publish
from deploy.board.releases.manifest import IDENTITY, NAMESPACE
from deploy.errors import DeployError
from ground_station.keys.authority import Authority

CONTENT = bytes(range(256)) * 4096
URL = "https://example.org/blimp"
# Of Imager's doc/json-schema/os-list-schema.json.
REQUIRED = {
    "name", "description", "icon", "url", "extract_size", "extract_sha256",
    "image_download_size", "release_date",
}  # fmt: skip


@pytest.fixture
def image(tmp_path: Path) -> Path:
    path = tmp_path / "blimp-zero2w.img"
    path.write_bytes(CONTENT)
    described = {
        "board": "zero2w", "version": "0.2.0+git1234", "made": "2026-11-26T00:00:00Z",
        "image": {"size": len(CONTENT), "sha256": hashlib.sha256(CONTENT).hexdigest()},
    }  # fmt: skip
    path.with_name(f"{path.name}.manifest.json").write_text(json.dumps(described))
    path.with_name(f"{path.name}.bmap").write_text("<bmap/>")
    return path


@pytest.fixture
def key(tmp_path: Path) -> Path:
    if shutil.which("ssh-keygen") is None or shutil.which("xz") is None:
        pytest.skip("no ssh-keygen or xz here")
    return Authority.create(tmp_path / "keys").release_key()[0]


def test_the_list_tells_what_is_downloaded_and_what_it_unpacks_to(image: Path, key: Path) -> None:
    out = publish.publish(image, f"{URL}/", image.parent / "out", key)
    (entry,) = json.loads((out / "os_list.json").read_text())["os_list"]
    assert entry.keys() >= REQUIRED and entry["devices"] == ["pi3-64bit"]
    packed = (out / entry["url"].removeprefix(f"{URL}/")).read_bytes()
    assert lzma.decompress(packed) == CONTENT
    assert entry["extract_size"] == len(CONTENT) and entry["image_download_size"] == len(packed)
    assert entry["extract_sha256"] == hashlib.sha256(CONTENT).hexdigest()
    assert entry["image_download_sha256"] == hashlib.sha256(packed).hexdigest()


def test_all_of_it_is_under_the_release_keys_signature(image: Path, key: Path) -> None:
    out = publish.publish(image, URL, image.parent / "out", key)
    sums = (out / "SHA256SUMS").read_text()
    assert {line.split()[1] for line in sums.splitlines()} | {"SHA256SUMS", "SHA256SUMS.sig"} == {
        path.name for path in out.iterdir()
    }
    subprocess.run(["sha256sum", "--quiet", "-c", "SHA256SUMS"], cwd=out, check=True)
    signers = out.with_name("signers")
    signers.write_text(f"{IDENTITY} {key.with_name(f'{key.name}.pub').read_text()}")
    words = ["ssh-keygen", "-Y", "verify", "-f", str(signers), "-I", IDENTITY, "-n", NAMESPACE]
    verify = [*words, "-s", str(out / "SHA256SUMS.sig")]
    assert subprocess.run(verify, input=sums.encode(), check=False).returncode == 0
    assert subprocess.run(verify, input=sums.encode() + b"x", check=False).returncode != 0


def test_an_image_that_is_not_as_built_or_starts_on_no_pi_is_refused(
    image: Path, key: Path
) -> None:
    manifest = image.with_name(f"{image.name}.manifest.json")
    with pytest.raises(DeployError, match="https://… is wanted"):
        publish.publish(image, "example.org", None, key)
    image.write_bytes(CONTENT[1:])
    with pytest.raises(DeployError, match="not as it was built; make image BOARD=zero2w"):
        publish.publish(image, URL, image.parent / "out", key)
    manifest.write_text(manifest.read_text().replace("zero2w", "qemu"))
    with pytest.raises(DeployError, match="which is no Raspberry Pi"):
        publish.publish(image, URL, image.parent / "out", key)
    manifest.unlink()
    with pytest.raises(DeployError, match="make image makes it"):
        publish.publish(image, URL, image.parent / "out", key)
    assert not (image.parent / "out").exists()


def test_what_lies_in_its_place_stays_and_what_was_cut_short_does_not(
    image: Path, key: Path
) -> None:
    out = image.parent / "out"
    out.mkdir()
    (out.with_name("out.part")).mkdir()
    (out.with_name("out.part") / "left").touch()
    publish.publish(image, URL, out, key)
    assert not (out / "left").exists()
    with pytest.raises(DeployError, match="is not empty"):
        publish.publish(image, URL, out, key)
