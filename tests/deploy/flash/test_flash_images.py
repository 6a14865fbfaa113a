"""Images, maps and keys that are refused before a byte of the card is touched."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
from pathlib import Path

import pytest
from card_bench import BOOT_OFFSET, MEBI, Bench, make_image, refused, run, sum_of, tool

from deploy.errors import DeployError
from deploy.flash import image


@pytest.fixture
def untouched(bench: Bench):  # type: ignore[no-untyped-def]
    """The bench; afterwards the card must be as it was."""
    before = bench.card.read_bytes()
    yield bench
    assert bench.card.read_bytes() == before


def test_a_wrong_or_missing_checksum(untouched: Bench) -> None:
    sums = Path(f"{untouched.image}.sha256")
    with open(untouched.image, "r+b") as file:
        file.seek(12 * MEBI)
        file.write(b"x")
    refused(untouched.command(), "its checksum is wrong", program=True)
    refused(untouched.command("--no-checksum"), "its checksum is wrong")
    sums.write_text("not a sum\n")
    refused(untouched.command(), "it tells no checksum")
    sums.unlink()
    refused(untouched.command(), "(--no-checksum goes on)")
    refused(untouched.command("--no-checksum"), "not the map of this image")


def test_a_card_that_is_too_small(untouched: Bench) -> None:
    small = untouched.folder / "small"
    small.write_bytes(b"o" * (untouched.image.stat().st_size - 512))
    words = dataclasses.replace(untouched, card=small).command()
    refused(words, f"the image needs {untouched.image.stat().st_size}", program=True)
    assert small.read_bytes().count(b"o") == small.stat().st_size


def test_an_image_that_is_not_ours_or_for_another_board(untouched: Bench) -> None:
    refused(untouched.command("--board", "zerow"), "an image for zero2w; this card is to be for")
    manifest = Path(f"{untouched.image}.manifest.json")
    manifest.write_text('{"schema": "blimp.image/9"}')
    refused(untouched.command(), "not of schema blimp.image/1")
    manifest.unlink()
    other = untouched.folder / "other.img"

    def words() -> list[str]:
        sum_of(other)
        return dataclasses.replace(untouched, image=other).command()

    make_image(other, label="SOMEBODY")
    refused(words(), "its boot partition is not BLIMPBOOT")
    make_image(other, folder=False)
    refused(words(), "has no folder 'blimp'")
    make_image(other)
    refused([*words(), "--board", "zerow"], "an image for a board that no .manifest.json tells")
    other.write_bytes(b"\0" * 5 * MEBI)
    refused(words(), "not a card image")
    other.write_bytes(b"")
    refused(words(), "not a card image")
    refused([w.replace("other.img", "none.img") for w in words()], "No such file")


def test_a_boot_partition_without_room(untouched: Bench) -> None:
    free = b"x" * (8 * MEBI - 400_000)
    target = ["-i", f"{untouched.image}@@{BOOT_OFFSET}", "-", "::/big"]
    tool("mcopy", *target, input=free)
    Path(f"{untouched.image}.bmap").unlink()
    sum_of(untouched.image)
    refused(untouched.command(), "bytes are free; needed")


def test_a_second_flasher_waits_its_turn(untouched: Bench) -> None:
    from deploy.flash.write import Target

    with Target.open(untouched.card):
        refused(untouched.command(), "another program writes it")
    with open(untouched.card, "rb"):  # a reader does no harm
        pass


def test_only_the_typed_name_goes_on(bench: Bench) -> None:
    before = bench.card.read_bytes()
    refused(bench.command(ask=True), "not confirmed", input="yes\n", program=True)
    refused(bench.command(ask=True), "not confirmed", input="")
    assert bench.card.read_bytes() == before
    assert run(bench.command(ask=True), input="card\n").returncode == 0


@pytest.mark.parametrize("words", [["--image", "x"], ["--payload", "x"], []])
def test_what_is_missing_is_named(tmp_path: Path, words: list[str], bench: Bench) -> None:
    base = [*bench.customise()[:3], "--device", str(bench.card), *words]
    refused(base, "is missing" if len(words) < 4 else "")


def test_keys_that_are_missing_anothers_revoked_or_cut(untouched: Bench) -> None:
    keys = untouched.folder / "keys"
    shutil.copytree(untouched.keys, keys)
    untouched.keys = keys
    folder = keys / "payload/blimp-1"
    refused([*untouched.command(), "--payload", "blimp-9"], "make them: blimp keys payload blimp-9")
    refused([*untouched.command(), "--payload", "../x"], "'payload.id' is '../x'")
    (keys / "revoked").mkdir()
    shutil.copytree(folder, keys / "revoked/payload.blimp-8")
    refused([*untouched.command(), "--payload", "blimp-8"], "was revoked")
    whole = (folder / "key.pem").read_bytes()
    (folder / "key.pem").write_bytes(whole[:50])
    refused(untouched.command(), "key.pem: not PEM, or cut")
    (folder / "key.pem").unlink()
    refused(untouched.command(), "key.pem: No such file")
    (folder / "key.pem").write_bytes(whole)
    access = json.loads((folder / "access.json").read_bytes())
    for change, said in (
        ({"name": "payload.blimp-2"}, "are those of 'payload.blimp-2'"),
        ({"peers": []}, "list no ground station"),
        ({"schema": "blimp.access/2"}, "not of schema blimp.access/1"),
    ):
        (folder / "access.json").write_text(json.dumps(access | change))
        refused(untouched.command(), said)


def test_a_wrong_wifi_or_ssh_key_is_named(untouched: Bench) -> None:
    base = untouched.command(wifi=False)
    wifi = [*base, "--wifi-password-file", str(untouched.password()), "--wifi-ssid"]
    refused([*wifi, "hall"], "--country is missing")
    refused([*wifi, "hall", "--country", "de"], "is it DE?")
    refused([*wifi, "x" * 33, "--country", "DE"], "has 33 bytes; allowed: 1 to 32")
    untouched.password("short\n")
    refused([*wifi, "hall", "--country", "DE"], "has 5 bytes; allowed: 8 to 63")
    untouched.password("")
    refused([*wifi, "hall", "--country", "DE"], "the card holds none for it")
    private = untouched.keys / "ground/main/ssh_ed25519"
    refused([*base, "--no-wifi", "--ssh-key", str(private)], "private key")
    file = untouched.folder / "wifi.toml"
    file.write_text('[wifi]\nssid = "a"\ncountry = "DE"\nkey = 1\n')
    refused([*base, "--wifi", str(file)], "wifi.toml: unknown key 'wifi.key'")


BOMB = b"""<?xml version="1.0"?><!DOCTYPE bmap [<!ENTITY a "aaaaaaaaaa">
<!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]><bmap version="2.0"><ImageSize>&b;</ImageSize></bmap>"""


def test_maps_that_are_hostile_cut_or_of_another_image(untouched: Bench) -> None:
    place = Path(f"{untouched.image}.bmap")
    good, size = place.read_bytes(), untouched.image.stat().st_size
    stretches = image.read_map(place, size)
    assert stretches[0].start == 0 and stretches[-1].stop == size and len(stretches) > 1

    def signed(data: bytes) -> bytes:
        """With its own checksum right again, as somebody who means harm would."""
        start = data.index(b"<BmapFileChecksum>") + len(b"<BmapFileChecksum>")
        while data[start : start + 1].isspace():
            start += 1
        data = data[:start] + b"0" * 64 + data[start + 64 :]
        digest = hashlib.sha256(data).hexdigest().encode()
        return data[:start] + digest + data[start + 64 :]

    second = f"{stretches[1].start // 4096}-{stretches[1].stop // 4096 - 1}".encode()
    start, stop = second.split(b"-")

    def ranged(text: bytes) -> bytes:
        assert good.count(second) == 1
        return good.replace(second, text)

    cases = [
        (BOMB, "it declares a document type"),
        (BOMB.decode().encode("utf-16"), "it declares a document type"),
        (good[:-40], "not a block map"),
        (good.replace(b"sha256", b"sha999", 1), "not a block map"),
        (b"<other/>", "<other> is not expected"),
        (b"\0" * 100, "not a block map"),
        (signed(good.replace(b'version="2.0"', b'version="3.0"')), "expected 2.0"),
        (signed(ranged(b"300-" + stop)), "not the map of this image"),
        (signed(ranged(b"300-299")), "backwards"),
        (signed(ranged(b"0-" + stop)), "overlaps"),
        (signed(ranged(start + b"-99999999")), "lies outside"),
        (signed(ranged(b"-1")), "not a block map"),
        (ranged(b"257-" + stop), "its own checksum is wrong"),
    ]
    for data, said in cases:
        place.write_bytes(data)
        with pytest.raises(DeployError) as caught, open(untouched.image, "rb") as file:
            if image.verify(file, image.read_map(place, size)) is not None:
                raise DeployError("not the map of this image")
        assert said in str(caught.value) and "\n" not in str(caught.value)
    for data, said in (cases[0], cases[6]):
        place.write_bytes(data)
        refused(untouched.command(), said)
    place.write_bytes(good)
    with pytest.raises(DeployError, match="it is of an image of"):
        image.read_map(place, size + 512)
