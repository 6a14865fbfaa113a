"""A card takes what the boot partition says, refuses what is wrong, and keeps secrets to itself."""

from __future__ import annotations

import json
import shutil
import stat
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
from board_cards import BLIMP, KEY, PASSWORD, WIFI, Person, certificates, renamed

from deploy.board import provision
from deploy.board.candidate import firmware_check
from deploy.board.card import Card
from deploy.errors import DeployError
from deploy.provisioning.model import GroundStation, Provisioning
from deploy.provisioning.text import parse, render
from deploy.provisioning.wpa import wpa_supplicant_conf

ROOT = Path(__file__).parents[3]


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def written(person: Person) -> dict[Path, tuple[int, int]]:
    """Which file it is and when it changed last; reading one does not count."""
    paths = {path: path.stat() for path in person.card.root.rglob("*")}
    return {path: (status.st_ino, status.st_mtime_ns) for path, status in paths.items()}


def test_the_first_boot_takes_everything_and_leaves_no_secret(person: Person) -> None:
    person.gives(keys=certificates(), settings="[camera]\nrate_hz = 25.0\n")
    outcome = person.boots()
    assert outcome == provision.Outcome("in force", "blimp-1", fresh=True, wifi=True)

    blimp = person.card.blimp
    document = tomllib.loads((blimp / "payload.toml").read_text())
    assert document == {
        "payload_id": "blimp-1",
        "camera": {"uri": "libcamera:", "rate_hz": 25.0},
        "link": {"host": "auto", "port": 5600},
        "telemetry": {
            "connect": [],
            "certificates": str(blimp / "certificates"),
            "discover": "wlan0",
        },
    }
    assert (blimp / "wpa_supplicant.conf").read_text() == wpa_supplicant_conf(BLIMP)
    for name in ("ca.pem", "certificate.pem", "key.pem", "access.json", "srtp.key"):
        assert (blimp / "certificates" / name).read_bytes() == certificates()[name]
    assert (person.card.ssh / "authorized_keys").read_text() == KEY + "\n"
    host_key = person.card.ssh / "ssh_host_ed25519_key"
    assert host_key.read_bytes() == certificates()["ssh_ed25519"]

    assert sorted(path.name for path in person.card.boot.iterdir()) == [
        "blimp.toml",
        "payload.toml",
    ]
    assert not person.holds_secret()
    left = parse((person.card.boot / "blimp.toml").read_bytes())
    assert left == renamed("hall")


def test_only_root_reads_secrets_and_the_firmware_what_it_needs(person: Person) -> None:
    person.gives(keys=certificates())
    person.boots()
    blimp = person.card.blimp
    assert mode(blimp) == mode(blimp / "certificates") == 0o750
    assert {mode(path) for path in (blimp / "certificates").iterdir()} == {0o640}
    assert mode(blimp / "payload.toml") == 0o640
    assert mode(blimp / "wpa_supplicant.conf") == mode(blimp / "provisioned.json") == 0o600
    assert mode(blimp / "ssh") == 0o700
    assert mode(person.card.ssh / "ssh_host_ed25519_key") == 0o600
    assert mode(person.card.ssh / "authorized_keys") == 0o644


def test_the_next_boots_change_nothing(person: Person) -> None:
    person.gives(keys=certificates())
    person.boots()
    before = written(person)
    assert person.boots() == provision.Outcome("in force", "blimp-1", wifi=True)
    assert written(person) == before
    assert len(person.checked) == 1


def test_without_a_file_nothing_is_in_force_and_a_lost_one_changes_nothing(person: Person) -> None:
    assert person.boots() == provision.Outcome("none")
    person.gives(keys=certificates())
    person.boots()
    (person.card.boot / "blimp.toml").unlink()
    assert person.boots().state == "in force"
    shutil.rmtree(person.card.boot)
    assert person.boots() == provision.Outcome("in force", "blimp-1", wifi=True)


def test_an_ending_that_an_editor_added_is_told(person: Person) -> None:
    (person.card.boot / "blimp.toml.txt").write_text(render(BLIMP))
    told = "there is blimp.toml.txt and no blimp.toml: take .txt off its name"
    assert person.boots() == provision.Outcome("refused", reason=told)


def test_another_network_is_one_edited_line(person: Person) -> None:
    person.gives(keys=certificates())
    person.boots()
    file = person.card.boot / "blimp.toml"
    text = (
        file.read_text()
        .replace('"hall"', '"gym"')
        .replace('password = ""', 'password = "another one"')
    )
    # As an editor on Windows saves it.
    file.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    outcome = person.boots()
    assert outcome.fresh and not outcome.reason
    told = (person.card.blimp / "wpa_supplicant.conf").read_text()
    assert told == wpa_supplicant_conf(renamed("gym", "another one"))
    assert (person.card.blimp / "certificates/key.pem").read_bytes() == certificates()["key.pem"]
    left = file.read_bytes()
    assert b"another one" not in left and left.count(b"\r\n") == left.count(b"\n")
    assert person.boots() == provision.Outcome("in force", "blimp-1", wifi=True)


def test_an_empty_password_keeps_the_one_on_the_card(person: Person) -> None:
    person.gives(keys=certificates())
    person.boots()
    file = person.card.boot / "blimp.toml"
    file.write_text(file.read_text().replace('country = "DE"', 'country = "US"'))
    assert person.boots().fresh
    told = (person.card.blimp / "wpa_supplicant.conf").read_text()
    assert "country=US" in told and told.count("psk=") == 1
    assert told == wpa_supplicant_conf(BLIMP).replace("country=DE", "country=US")


def test_new_settings_and_new_board_defaults_are_taken_alone(person: Person) -> None:
    person.gives(keys=certificates())
    person.boots()
    (person.card.boot / "payload.toml").write_text("[gate]\nenabled = false\n")
    assert person.boots().fresh
    assert "enabled = false" in (person.card.blimp / "payload.toml").read_text()
    person.card.defaults.write_text('[camera]\nuri = "v4l2:/dev/video0"\n')
    assert person.boots().fresh
    (person.card.boot / "payload.toml").unlink()
    assert person.boots().fresh
    told = (person.card.blimp / "payload.toml").read_text()
    assert "enabled" not in told and "v4l2" in told


def test_new_certificates_replace_all_the_old_ones(person: Person) -> None:
    first = {**certificates(), "allowed_signers": b"someone\n"}
    person.gives(keys=first)
    person.boots()
    assert (person.card.blimp / "certificates/allowed_signers").exists()
    person.gives((person.card.boot / "blimp.toml").read_bytes(), keys=certificates(mark="2"))
    assert person.boots().fresh and not person.holds_secret()
    held = person.card.blimp / "certificates"
    assert (held / "key.pem").read_bytes() == certificates(mark="2")["key.pem"]
    assert not (held / "allowed_signers").exists()
    host = (person.card.ssh / "ssh_host_ed25519_key").read_bytes()
    assert host == certificates(mark="2")["ssh_ed25519"]


def test_without_a_persons_key_there_is_no_ssh(person: Person) -> None:
    person.gives(keys=certificates())
    person.boots()
    person.gives(Provisioning("blimp-1", WIFI))
    person.boots()
    assert not (person.card.ssh / "authorized_keys").exists()


@pytest.mark.skipif(shutil.which("ssh-keygen") is None, reason="ssh-keygen is not installed")
def test_a_card_without_a_host_key_makes_its_own_once(person: Person) -> None:
    keys = {k: v for k, v in certificates().items() if not k.startswith("ssh_")}
    person.gives(keys=keys)
    assert not person.boots().warning
    key = person.card.ssh / "ssh_host_ed25519_key"
    made = key.read_bytes()
    assert made.startswith(b"-----BEGIN OPENSSH PRIVATE KEY") and mode(key) == 0o600
    person.boots()
    assert key.read_bytes() == made
    assert {path.name for path in person.card.ssh.iterdir()} == {
        "authorized_keys",
        "ssh_host_ed25519_key",
        "ssh_host_ed25519_key.pub",
    }


def test_a_cable_and_a_named_station(person: Person) -> None:
    station = GroundStation("fd00::5", 5700)
    person.gives(Provisioning("blimp-1", ground_station=station), keys=certificates())
    assert person.boots() == provision.Outcome("in force", "blimp-1", fresh=True)
    document = tomllib.loads((person.card.blimp / "payload.toml").read_text())
    assert document["link"] == {"host": "fd00::5", "port": 5700}
    assert document["telemetry"]["connect"] == ["tls/[fd00::5]:7447"]
    assert "discover" not in document["telemetry"]
    assert not (person.card.blimp / "wpa_supplicant.conf").exists()


# What a person gives, and the refusal; by themselves BLIMP and its certificates are right.
WRONG: list[tuple[dict[str, Any], str]] = [
    ({"what": b"schema = "}, "blimp.toml: not valid TOML"),
    ({"what": b'schema = 1\nrocket = 1\n[payload]\nid = "a"\n'}, "blimp.toml: unknown key"),
    ({"what": b"#" * 300000}, "blimp.toml has more than 262144 bytes"),
    ({"what": renamed("hall")}, "'wifi.password' is empty, and the card holds none"),
    ({"keys": {}}, "certificates/ is missing: put the folder there"),
    (
        {"keys": {k: v for k, v in certificates().items() if k != "key.pem"}},
        "certificates/ lacks key.pem",
    ),
    (
        {"keys": certificates("other")},
        "certificates/ is of 'payload.other', and 'payload.id' is 'blimp-1'",
    ),
    ({"keys": certificates() | {"access.json": b"[]"}}, "certificates/access.json is damaged"),
    ({"keys": {"readme.txt": b"?"}}, "certificates/ holds none of ca.pem"),
    ({"keys": certificates() | {"key.pem": b"k" * 70000}}, "key.pem has more than 65536 bytes"),
    ({"settings": "rate"}, "payload.toml: not valid TOML"),
    ({"settings": "link = 5"}, "payload.toml: 'link' must be a table"),
    ({"settings": "[camera]\nwhen = 2026-01-01\n"}, "payload.toml: 'camera.when' is a date"),
]


@pytest.mark.parametrize(("given", "told"), WRONG)
def test_what_is_wrong_is_refused_and_the_old_stays_in_force(
    person: Person, given: dict[str, Any], told: str
) -> None:
    given = {"keys": certificates(), **given}
    fresh = Person(person.card.root / "fresh")
    fresh.gives(**given)
    before = fresh.state()
    outcome = fresh.boots()
    assert outcome.state == "refused" and outcome.payload_id == ""
    assert told in outcome.reason and "\n" not in outcome.reason and PASSWORD not in outcome.reason
    assert fresh.state() == before  # the person's files, too: to be repaired there

    person.gives(renamed("gym", "first password"), keys=certificates(mark="0"))
    person.boots()
    held = {k: v for k, v in person.state().items() if k.startswith("data")}
    if told.startswith(("'wifi.password", "certificates/ is missing")):
        return  # the card has those by now
    person.gives(**given)
    outcome = person.boots()
    assert (outcome.state, outcome.payload_id) == ("refused", "blimp-1") and told in outcome.reason
    assert {k: v for k, v in person.state().items() if k.startswith("data")} == held


def test_what_the_firmware_refuses_is_not_taken(person: Person) -> None:
    def check(folder: Path) -> None:
        raise DeployError("the firmware refuses it: 'camera.rate_hz' is 500")

    person.gives(keys=certificates())
    outcome = person.boots(check=check)
    assert (outcome.state, outcome.reason) == (
        "refused",
        "the firmware refuses it: 'camera.rate_hz' is 500",
    )
    assert [path.name for path in person.card.data.iterdir()] == []
    assert person.holds_secret()


def test_secrets_that_cannot_be_taken_out_are_told(
    person: Person, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(card: Card) -> None:
        raise DeployError("mount: it is write-protected")

    monkeypatch.setattr(provision, "writable", broken)
    person.gives(keys=certificates())
    outcome = person.boots()
    assert outcome.state == "in force"
    assert outcome.warning == (
        "the secrets are still on the boot partition: mount: it is write-protected"
    )
    assert person.holds_secret()
    monkeypatch.undo()
    assert not person.boots().warning and not person.holds_secret()


def test_files_of_the_laptop_go_with_the_certificates_and_links_are_not_followed(
    person: Person, tmp_path: Path
) -> None:
    aside = tmp_path / "aside"
    aside.write_bytes(b"not ours")
    person.gives(keys={**certificates(), "._key.pem": b"private", ".DS_Store": b"private"})
    (person.card.boot / "certificates/link").symlink_to(aside)
    assert person.boots().state == "in force"
    assert not (person.card.boot / "certificates").exists()
    assert aside.read_bytes() == b"not ours"


def test_the_firmwares_own_check_judges_the_merged_file(tmp_path: Path) -> None:
    """With the real firmware and real certificates' form: its SRTP key is read, too."""
    check = firmware_check(ROOT)
    person = Person(tmp_path)
    person.card.defaults.write_text('[camera]\nuri = "test:"\n')
    person.gives(keys=certificates(), settings="[camera]\nrate_hz = 500\n")
    outcome = person.boots(check=check)
    assert outcome.reason == (
        "the firmware refuses it: payload.toml: 'camera.rate_hz' is 500.0; allowed: 1 to 120 Hz"
    )
    person.gives(keys={**certificates(), "srtp.key": b"zz"}, settings="")
    outcome = person.boots(check=check)
    assert outcome.reason.startswith("the firmware refuses it: certificates/srtp.key: not hexa")
    person.gives(keys=certificates())
    assert person.boots(check=check).state == "in force"


def test_the_program_says_what_it_did(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    person = Person(tmp_path)
    person.card.defaults.write_text("")
    release = tmp_path / "usr/lib/blimp/release"
    release.mkdir(parents=True)
    (release / "pi_firmware").symlink_to(ROOT / "pi_firmware")
    told = {"schema": "blimp.release/1", "version": "1.0.0", "machine": "x86_64"}
    told |= {"python": f"3.{sys.version_info[1]}", "made": "2026-01-01T00:00:00Z"}
    (release / "release.json").write_text(json.dumps(told))
    person.gives(keys=certificates())
    assert provision.main(["--root", str(tmp_path)]) == 0
    assert capsys.readouterr().out == "provision: in force: blimp-1\n"
    assert json.loads(person.card.outcome.read_text())["payload_id"] == "blimp-1"


@pytest.mark.parametrize(
    ("payload_id", "name"), [("blimp-1", "blimp-1"), ("a_b-", "a-b"), ("0", "0"), ("_", "blimp")]
)
def test_a_payloads_name_in_the_network(payload_id: str, name: str) -> None:
    assert provision.host_name(payload_id) == name


def test_the_boards_own_name_has_an_address() -> None:
    """Else sudo, which asks for it, waits for a name server each time."""
    lines = [line.split() for line in provision.hosts_text("blimp-1").splitlines()]
    assert [line[0] for line in lines] == ["127.0.0.1", "::1"]
    assert all(line[1:] == ["localhost", "blimp-1"] for line in lines)
