"""Flashing to a file: equal content, customised, nothing else touched."""

from __future__ import annotations

import dataclasses
import json
import lzma
import shutil
from datetime import UTC, datetime
from pathlib import Path

import pytest
from card_bench import BOOT_OFFSET, GAP_MIB, MEBI, Bench, make_image, refused, run, tool

from deploy.flash import __main__ as command
from deploy.provisioning.text import parse
from deploy.provisioning.wpa import psk, wpa_supplicant_conf
from ground_station.keys.authority import Authority

BOOT_MIB, ROOT_MIB = 8, 8
BOOT_END = BOOT_OFFSET + BOOT_MIB * MEBI
GAP = slice(BOOT_END + ROOT_MIB * MEBI, BOOT_END + (ROOT_MIB + GAP_MIB) * MEBI)
KEYS = (
    "ca.pem", "certificate.pem", "key.pem", "access.json", "srtp.key", "ssh_ed25519",
    "ssh_ed25519.pub", "allowed_signers",
)  # fmt: skip


def test_the_card_holds_the_image_and_what_was_asked_for(bench: Bench, tmp_path: Path) -> None:
    old = bench.card.read_bytes()
    done = run(bench.command("--ground", "10.1.2.3"), program=True)
    assert done.returncode == 0, done.stderr
    image, card = bench.image.read_bytes(), bench.card.read_bytes()
    assert card[:BOOT_OFFSET] == image[:BOOT_OFFSET]
    assert card[BOOT_END : GAP.start] == image[BOOT_END : GAP.start]
    assert card[GAP.stop : len(image)] == image[GAP.stop :]
    # Blocks that mean nothing, and what lies behind the image, are as they were.
    assert card[GAP] == old[GAP] and card[len(image) :] == old[len(image) :]

    told = parse(bench.toml())
    assert told.payload_id == "blimp-1" and told.ground_station.host == "10.1.2.3"
    assert told.wifi is not None
    assert (told.wifi.ssid, told.wifi.password, told.wifi.country) == (
        b"hall", "correct horse", "DE",
    )  # fmt: skip
    for name in KEYS:
        made = (bench.keys / "payload/blimp-1" / name).read_bytes()
        assert bench.read(f"blimp/certificates/{name}") == made
    ground = (bench.keys / "ground/main/ssh_ed25519.pub").read_text().split()
    assert [key.split()[:2] for key in told.authorized_keys] == [ground[:2]]
    for name in ("config.txt", "kernel8.img"):
        assert bench.read(name) == bench.read(name, bench.image)
    _file_systems_are_clean(bench, tmp_path)
    assert "correct horse" not in done.stdout + done.stderr


def _file_systems_are_clean(bench: Bench, folder: Path) -> None:
    parts = ((1, BOOT_MIB, ["fsck.vfat", "-n"]), (1 + BOOT_MIB, ROOT_MIB, ["e2fsck", "-fn"]),
             (1 + BOOT_MIB + ROOT_MIB + GAP_MIB, 4, ["e2fsck", "-fn"]))  # fmt: skip
    for start, size, check in parts:
        part = folder / "part"
        with open(bench.card, "rb") as card:
            card.seek(start * MEBI)
            part.write_bytes(card.read(size * MEBI))
        tool(*check, str(part))


def test_it_ends_with_the_command_that_hears_the_card(bench: Bench, tmp_path: Path) -> None:
    """And notes beside the keys, for the doctor, which stations the card was told."""
    keys = tmp_path / "of-hall"
    shutil.copytree(bench.keys, keys)
    authority = Authority(keys)
    command = "blimp serve --lan"
    assert run(bench.command()).stdout.splitlines()[-1].endswith(command)
    authority.add("ground", "hall")
    authority.revoke("ground.main")
    bench.keys = keys
    assert run(bench.command()).stdout.splitlines()[-1].endswith(f"{command} --set name=hall")
    note = keys / "payload/blimp-1/flashed.json"
    assert json.loads(note.read_text())["peers"] == ["ground.hall"]
    assert note.stat().st_mode & 0o777 == 0o600 and authority.check(datetime.now(UTC)) == []


def test_a_second_flash_with_other_wifi_changes_only_that(bench: Bench, tmp_path: Path) -> None:
    """The whole card again, and again with settings only: all files and bytes but blimp.toml's."""
    assert run(bench.command()).returncode == 0
    first = tmp_path / "first"
    shutil.copy(bench.card, first)
    other = bench.password("another one")
    words = ["--wifi-ssid", "other", "--wifi-password-file", str(other), "--country", "FR"]
    for again in (bench.command(*words, wifi=False), bench.customise(*words)):
        shutil.copy(first, bench.card)
        done = run(again)
        assert done.returncode == 0, done.stderr
        before, after = parse(bench.toml(first)), parse(bench.toml())
        assert after.wifi is not None and before.wifi is not None
        assert (after.wifi.ssid, after.wifi.password, after.wifi.country) == (
            b"other", "another one", "FR",
        )  # fmt: skip
        assert (before.payload_id, before.ground_station, before.authorized_keys) == (
            after.payload_id, after.ground_station, after.authorized_keys,
        )  # fmt: skip
        names = bench.listed()
        assert names == bench.listed(first)
        for name in names:
            if not name.endswith("/") and not name.endswith("blimp.toml"):
                assert bench.read(name) == bench.read(name, first), name
        old, new = first.read_bytes(), bench.card.read_bytes()
        assert old[:BOOT_OFFSET] == new[:BOOT_OFFSET] and old[BOOT_END:] == new[BOOT_END:]
    # Settings only: the file's clusters, its entry and its row in both tables; no other sector.
    sectors = {i // 512 for i in range(BOOT_OFFSET, BOOT_END) if old[i] != new[i]}
    assert 0 < len(sectors) < 16


def test_settings_that_are_there_already_change_no_byte(bench: Bench) -> None:
    assert run(bench.command()).returncode == 0
    before = bench.card.read_bytes()
    done = run(bench.customise("--payload", "blimp-1"))
    assert done.returncode == 0 and "as asked already" in done.stdout, done.stderr
    assert bench.card.read_bytes() == before


def test_settings_change_an_image_file_too_and_only_what_was_named(bench: Bench) -> None:
    """An image straight from the builder, customised without a device and without a flash."""
    shutil.copy(bench.image, bench.card)
    refused(bench.customise(), "--payload is missing")
    refused(bench.customise("--payload", "blimp-2"), "--no-wifi")
    refused(bench.customise("--payload", "blimp-2", "--no-wifi", "--country", "DE"), "no Wi-Fi")
    words = bench.customise("--payload", "blimp-2", "--no-wifi", "--ground", "gs.local")
    assert run(words).returncode == 0
    told = parse(bench.toml())
    assert (told.payload_id, told.wifi, told.ground_station.host) == ("blimp-2", None, "gs.local")
    wifi = ["--wifi-ssid", "hall", "--wifi-password-file", str(bench.password()), "--country", "DE"]
    assert run(bench.customise(*wifi)).returncode == 0
    assert run(bench.customise("--ground", "auto", "--no-ssh", "--country", "NL")).returncode == 0
    told = parse(bench.toml())
    assert told.wifi is not None and told.wifi.password == "correct horse"
    assert told.wifi.country == "NL" and told.authorized_keys == ()
    assert json.loads(bench.read("blimp/certificates/access.json"))["name"] == "payload.blimp-2"


def test_another_payloads_keys_leave_none_of_the_first(bench: Bench) -> None:
    shutil.copy(bench.image, bench.card)
    assert run(bench.customise("--payload", "blimp-1", "--no-wifi")).returncode == 0
    words = ["mcopy", "-i", f"{bench.card}@@{BOOT_OFFSET}", "-", "::/blimp/certificates/left"]
    tool(*words, input=b"another tool's")
    assert run(bench.customise("--payload", "blimp-2")).returncode == 0
    assert "blimp/certificates/left" not in bench.listed()
    for name in KEYS:
        made = (bench.keys / "payload/blimp-2" / name).read_bytes()
        assert bench.read(f"blimp/certificates/{name}") == made


def test_settings_that_are_damaged_are_written_anew_when_all_is_named(bench: Bench) -> None:
    """As after a power cut while the card or a laptop wrote them."""
    shutil.copy(bench.image, bench.card)
    target = ["mcopy", "-i", f"{bench.card}@@{BOOT_OFFSET}", "-", "::/blimp/blimp.toml"]
    tool(*target, input=bytes(512))
    refused(bench.customise("--no-wifi"), "it holds a NUL byte")
    refused(bench.customise("--payload", "blimp-1"), "--no-wifi")
    assert run(bench.customise("--payload", "blimp-1", "--no-wifi")).returncode == 0
    assert parse(bench.toml()).payload_id == "blimp-1"


def test_an_empty_password_keeps_the_cards_own_of_the_same_network(bench: Bench) -> None:
    assert run(bench.command()).returncode == 0
    empty = ["--wifi-password-file", str(bench.password("")), "--country", "CH"]
    assert run(bench.customise("--wifi-ssid", "hall", *empty)).returncode == 0
    told = parse(bench.toml())
    assert told.wifi is not None
    assert (told.wifi.password, told.wifi.country) == ("correct horse", "CH")
    refused(bench.customise("--wifi-ssid", "other", *empty), "the card holds none for it")


@pytest.mark.parametrize("by", ["options", "file"])
def test_quotes_newlines_and_commands_arrive_and_execute_nothing(bench: Bench, by: str) -> None:
    """To the end of the chain: the bytes that wpa_supplicant gets. No marker may appear."""
    marker = bench.folder / "marker"
    ssid = f"$(>{marker.name}) \"'\\ ü🎈"
    password = f"a \"b\" 'c' `touch {marker}`\n$(touch {marker}) \\\t🎈 "
    password = password.encode()[:60].decode(errors="ignore")
    assert len(ssid.encode()) <= 32
    if by == "options":
        file = bench.password(password + "\n")  # as an editor ends it
        words = ["--wifi-ssid", ssid, "--wifi-password-file", str(file), "--country", "DE"]
    else:
        file = bench.folder / "it's a $(touch marker).toml"
        quoted = [json.dumps(text, ensure_ascii=False) for text in (ssid, password)]
        lines = f'[wifi]\r\nssid = {quoted[0]}\r\npassword = {quoted[1]}\r\ncountry = "DE"\r\n'
        file.write_bytes(b"\xef\xbb\xbf" + lines.encode())
        words = ["--wifi", str(file)]
    done = run(bench.command(*words, wifi=False))
    assert done.returncode == 0, done.stderr
    told = parse(bench.toml())
    assert told.wifi is not None
    assert (told.wifi.ssid, told.wifi.password) == (ssid.encode(), password)
    conf = wpa_supplicant_conf(told)
    assert f"ssid={ssid.encode().hex()}\n" in conf
    assert f"psk={psk(password, ssid.encode())}\n" in conf
    assert list(bench.folder.rglob("marker")) == []


def test_a_packed_image_is_the_same(bench: Bench) -> None:
    packed = bench.folder / (bench.image.name + ".xz")
    packed.write_bytes(lzma.compress(bench.image.read_bytes(), preset=0))
    bench.image.rename(bench.folder / "unpacked")
    words = dataclasses.replace(bench, image=packed).command()
    done = run(words)  # checked by the checksum and the map of what is in it
    assert done.returncode == 0, done.stderr
    image, card = (bench.folder / "unpacked").read_bytes(), bench.card.read_bytes()
    assert card[BOOT_END : GAP.start] == image[BOOT_END : GAP.start]
    whole = packed.read_bytes()
    packed.write_bytes(whole[:-1000])
    before = bench.card.read_bytes()
    refused(words, ".xz file is cut")
    packed.write_bytes(whole[:5000] + b"\0" * 100 + whole[5100:])
    refused(words, "damaged")
    assert bench.card.read_bytes() == before


def test_without_a_map_all_of_it_is_written(bench: Bench) -> None:
    Path(f"{bench.image}.bmap").unlink()
    assert run(bench.command()).returncode == 0
    image, card = bench.image.read_bytes(), bench.card.read_bytes()
    assert card[BOOT_END : len(image)] == image[BOOT_END:]


def test_settings_of_the_firmware_are_checked_by_the_firmware(bench: Bench) -> None:
    settings = bench.folder / "payload.toml"
    settings.write_text("[camera]\nrate_hz = 5000\n")
    refused(
        bench.command("--payload-toml", str(settings)), "payload.toml: 'camera.rate_hz' is 5000"
    )
    settings.write_text("[camera]\nrate_hz = 15\n[telemetry]\nconnect = ['tls/10.0.0.1:7447']\n")
    assert run(bench.command("--payload-toml", str(settings))).returncode == 0
    assert bench.read("blimp/payload.toml") == settings.read_bytes()
    # The ground station that the card is told of needs none of its own in there.
    settings.write_text("[gate]\nenabled = false\n")
    more = ["--payload-toml", str(settings)]
    for ground in ("auto", "10.0.2.2"):
        assert run(bench.command(*more, "--ground", ground)).returncode == 0, ground
    assert run(bench.customise(*more)).returncode == 0


def test_no_wifi_is_said_and_no_password_is_on_a_command_line(bench: Bench) -> None:
    refused(bench.command(wifi=False), "--no-wifi")
    assert run(bench.command("--no-wifi", wifi=False)).returncode == 0
    assert parse(bench.toml()).wifi is None
    # No terminal to ask on, and no file.
    words = ["--wifi-ssid", "hall", "--country", "DE"]
    refused(
        bench.command(*words, wifi=False),
        "--wifi-password-file, or run it on a terminal",
        program=True,
    )
    assert "--wifi-password " not in command._parser().format_help()


def test_an_image_with_a_fat32_and_odd_names_works(bench: Bench) -> None:
    odd = bench.folder / "my card's @@1 $(x) ü.img"
    plain = bench.folder / "plain"  # mtools itself cannot take such a name
    make_image(plain, boot_mib=40)
    plain.rename(odd)
    card = bench.folder / "-i @@ card.img"
    card.write_bytes(bytes(odd.stat().st_size))
    words = dataclasses.replace(bench, image=odd, card=card).command()
    refused(words, "--no-checksum")
    done = run([*words, "--no-checksum"])
    assert done.returncode == 0, done.stderr
    shutil.move(card, bench.card)
    assert parse(bench.toml()).payload_id == "blimp-1"
