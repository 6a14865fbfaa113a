"""Makes what is given to people without this checkout of a built image: `python -m deploy.publish`.

A folder with the image, compressed, its block map and manifest, `os_list.json` for Raspberry Pi
Imager, and SHA256SUMS over all of them, signed by the authority's release key. The same image gives
the same list; nothing of a payload's own, name, network or key, is in it.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from deploy.errors import DeployError
from deploy.image.card import beside
from deploy.image.sparse import sha256
from deploy.run import run
from deploy.update import bundle

SUMS = "SHA256SUMS"
# What Raspberry Pi Imager calls the boards that an image starts on.
_DEVICES = {"zero2w": ["pi3-64bit"], "zerow": ["pi1-32bit"]}
_ICON = (
    "data:image/svg+xml,%3Csvg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 32 32'%3E%3Cpath"
    " d='M2 15c0-5 6-8 13-8 6 0 10 3 12 6l4-3v10l-4-3c-2 3-6 6-12 6-7 0-13-3-13-8z'/%3E%3C/svg%3E"
)
_EXAMPLE = """\
example:
  python -m deploy.publish out/image/blimp-zero2w.img --url https://example.org/blimp

Give the folder's content to a server under that address; then, on any system:
  rpi-imager --repo https://example.org/blimp/os_list.json
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Status 0, or 2 with one line on what a person can fix."""
    parser = argparse.ArgumentParser(
        prog="python -m deploy.publish",
        description="Compresses and signs an image, and lists it for Raspberry Pi Imager.",
        epilog=_EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("image", type=Path, metavar="IMAGE", help="of make image")
    parser.add_argument("--url", required=True, help="where the folder will be, https://…")
    parser.add_argument("--out", type=Path, metavar="DIR", help="default: out/release/VERSION")
    parser.add_argument("--keys", type=Path, metavar="DIR", help="of `blimp keys`")
    given = parser.parse_args(arguments)
    try:
        print(publish(given.image, given.url, given.out, bundle.release_key(given.keys)))
    except DeployError as error:
        print(f"deploy.publish: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"deploy.publish: {error.filename}: {error.strerror or error}", file=sys.stderr)
        return 2
    return 0


def publish(image: Path, url: str, out: Path | None, key: Path) -> Path:
    """Fills a folder, new or empty, and returns it.

    Raises `DeployError` for an image that is not as it was built, one for no Raspberry Pi, an
    address that is none, or a folder in use; `OSError` for what the disk refuses.
    """
    if not url.startswith("https://"):
        raise DeployError(f"--url {url!r:.80}: https://… is wanted, where the files will be")
    described = _described(image)
    board, version = str(described["board"]), str(described["version"])
    if board not in _DEVICES:
        raise DeployError(f"{image}: for the board '{board}', which is no Raspberry Pi")
    if sha256(image) != described["image"]["sha256"]:
        raise DeployError(f"{image}: not as it was built; make image BOARD={board}")
    out = out or Path("out/release") / version
    if out.exists() and any(out.iterdir()):
        raise DeployError(f"{out}: is not empty; take it away, or name another by --out")
    part = out.with_name(f"{out.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    packed = part / f"{image.name}.xz"
    run(["sh", "-c", 'xz -T0 -6 -c -- "$1" >"$2"', "xz", image, packed], timeout_s=3600)
    for suffix in (".bmap", ".manifest.json"):
        shutil.copy(beside(image, suffix), part)
    listed = {"os_list": [_entry(described, packed, url.rstrip("/"))]}
    (part / "os_list.json").write_text(json.dumps(listed, indent=2) + "\n")
    sums = "".join(f"{sha256(path)}  {path.name}\n" for path in sorted(part.iterdir()))
    (part / SUMS).write_text(sums)
    (part / f"{SUMS}.sig").write_bytes(bundle.sign(sums.encode(), key))
    if out.exists():
        out.rmdir()
    part.replace(out)
    return out


def _described(image: Path) -> dict[str, Any]:
    path = beside(image, ".manifest.json")
    try:
        described: dict[str, Any] = json.loads(path.read_text())
        _ = [described[key] for key in ("board", "version", "made")], described["image"]["sha256"]
    except FileNotFoundError:
        raise DeployError(f"{path}: not there; make image makes it, beside the image") from None
    except (ValueError, KeyError, TypeError):
        raise DeployError(f"{path}: not an image's manifest; make image makes both") from None
    return described


def _entry(described: dict[str, Any], packed: Path, url: str) -> dict[str, Any]:
    """An image in Imager's list (its doc/json-schema/os-list-schema.json)."""
    return {
        "name": f"Blimp payload {described['version']}",
        "description": "Camera payload of an indoor blimp. Its name, network and keys are put onto"
        " the written card by deploy.flash --customise-only",
        "icon": _ICON,
        "url": f"{url}/{packed.name}",
        "extract_size": described["image"]["size"],
        "extract_sha256": described["image"]["sha256"],
        "image_download_size": packed.stat().st_size,
        "image_download_sha256": sha256(packed),
        "release_date": described["made"][:10],
        "devices": _DEVICES[described["board"]],
    }


if __name__ == "__main__":
    sys.exit(main())
