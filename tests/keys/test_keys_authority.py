"""The authority writes what only its owner reads, overwrites nothing, and says what is wrong."""

import datetime
import itertools
import json
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from power import PowerCut, cut_after

from ground_station.cli import main
from ground_station.errors import KeysError
from ground_station.keys.authority import Authority, alone, write_private
from pi_firmware.wire import credentials
from pi_firmware.wire.errors import TelemetryError

NOW = datetime.datetime.now(datetime.UTC)


@pytest.fixture
def authority(authority: Authority) -> Authority:
    """With a second payload."""
    authority.add("payload", "blimp-2")
    return authority


def test_every_file_is_its_owners_only_and_nothing_is_left_half(authority: Authority) -> None:
    files = [path for path in authority.folder.rglob("*") if path.is_file()]
    assert len(files) > 15
    assert all(path.stat().st_mode & 0o777 == 0o600 for path in files)
    assert not [path for path in files if path.suffix == ".part"]
    assert Authority(authority.folder).check(NOW) == []


def test_each_side_lists_the_other(authority: Authority) -> None:
    ground = credentials.load(authority.of("ground.main"))
    assert ground.peers == ("payload.blimp-1", "payload.blimp-2")
    assert credentials.load(authority.of("payload.blimp-2")).peers == ("ground.main",)
    one = (authority.of("payload.blimp-1") / "srtp.key").read_text()
    assert len(bytes.fromhex(one)) == 30
    assert (authority.of("ground.main") / "srtp" / "blimp-1.key").read_text() == one


def test_certificates_hold_on_a_board_that_boots_in_1970(authority: Authority) -> None:
    from cryptography import x509

    read = x509.load_pem_x509_certificate(
        (authority.of("payload.blimp-1") / "certificate.pem").read_bytes()
    )
    assert read.not_valid_before_utc.year == 1970
    assert read.not_valid_after_utc > NOW + datetime.timedelta(days=700)


def test_nothing_is_overwritten(authority: Authority, tmp_path: Path) -> None:
    before = (authority.of("payload.blimp-1") / "key.pem").read_bytes()
    with pytest.raises(KeysError, match="exists already"):
        authority.add("payload", "blimp-1")
    with pytest.raises(KeysError, match="never overwritten"):
        Authority.create(authority.folder)
    with pytest.raises(KeysError, match="never overwritten"):
        write_private(authority.of("payload.blimp-1") / "key.pem", b"")
    assert (authority.of("payload.blimp-1") / "key.pem").read_bytes() == before


@pytest.mark.parametrize("name", ["", "..", "../x", "a/b", "A", "a.b", "a b", "*", "é", "x" * 33])
def test_hostile_names_are_refused(authority: Authority, name: str) -> None:
    for role in ("payload", "ground"):
        with pytest.raises(KeysError, match="allowed are 1 to 32"):
            authority.add(role, name)
    with pytest.raises((KeysError, TelemetryError)):
        authority.revoke(f"payload.{name}")


def test_a_revoked_name_is_off_the_lists_and_does_not_come_back(authority: Authority) -> None:
    authority.revoke("payload.blimp-1")
    assert credentials.load(authority.of("ground.main")).peers == ("payload.blimp-2",)
    assert not (authority.of("ground.main") / "srtp" / "blimp-1.key").exists()
    assert not authority.of("payload.blimp-1").exists()
    with pytest.raises(KeysError, match="was revoked"):
        authority.add("payload", "blimp-1")
    assert Authority(authority.folder).check(NOW) == []


def test_a_rotation_keeps_neighbouring_steps_on_speaking_terms(authority: Authority) -> None:
    from ground_station.keys.certificates import inspect

    folder = authority.of("payload.blimp-1")

    def files() -> tuple[bytes, bytes]:
        return (folder / "certificate.pem").read_bytes(), (folder / "ca.pem").read_bytes()

    steps = [files()]
    for said in ("both trusted", "new certificates", "settled"):
        assert authority.rotate() == said
        assert Authority(authority.folder).check(NOW) == []
        steps.append(files())
    for (one, trust_one), (two, trust_two) in itertools.pairwise(steps):
        assert inspect(one, trust_two)[0] == inspect(two, trust_one)[0] == "payload.blimp-1"
    with pytest.raises(KeysError, match="none of the trusted"):
        inspect(steps[0][0], steps[-1][1])


def test_check_finds_what_is_wrong(authority: Authority) -> None:
    one = authority.of("payload.blimp-1")
    (one / "key.pem").chmod(0o644)
    (authority.of("payload.blimp-2") / "certificate.pem").write_bytes(b"\x00 no certificate")
    text = "\n".join(authority.check(NOW))
    assert "key.pem: others can read it" in text and "payload.blimp-2: it is no PEM" in text
    assert "ends on" in "\n".join(authority.check(NOW + datetime.timedelta(days=720)))


def test_check_finds_a_key_that_is_not_the_certificates(authority: Authority) -> None:
    one, two = authority.of("payload.blimp-1"), authority.of("payload.blimp-2")
    swapped = (one / "key.pem").read_bytes()
    write_private(one / "key.pem", (two / "key.pem").read_bytes(), replace=True)
    assert authority.check(NOW) == [
        "payload.blimp-1: the private key is not the certificate's",
    ]
    for body in (b"", b"-----BEGIN PRIVATE KEY-----\n!\n-----END PRIVATE KEY-----\n", b"\xff"):
        write_private(one / "key.pem", body, replace=True)
        assert authority.check(NOW) == [
            "payload.blimp-1: its key or certificate is not readable PEM"
        ]
    write_private(one / "key.pem", swapped, replace=True)
    assert authority.check(NOW) == []
    write_private(authority.folder / "authorities" / "1.key", swapped, replace=True)
    assert authority.check(NOW) == ["authority 1: the private key is not the certificate's"]


ENDLESS = b'{"schema":"blimp.authority/1","members":{},"trusted":[1],"signing":1e999,"step":0}'


@pytest.mark.parametrize(
    "body", [b"", b"\xff", b"[]", b"{}", b'{"schema": 3}', b"[" * 9999, ENDLESS]
)
def test_a_hostile_folder_is_one_line(authority: Authority, body: bytes) -> None:
    (authority.folder / "authority.json").write_bytes(body)
    with pytest.raises(KeysError) as caught:
        Authority(authority.folder)
    (authority.of("ground.main") / "access.json").write_bytes(body)
    with pytest.raises(TelemetryError) as refused:
        credentials.load(authority.of("ground.main"))
    assert "\n" not in str(caught.value) + str(refused.value)


def test_an_access_list_names_the_other_side_only(authority: Authority) -> None:
    access = authority.of("payload.blimp-1") / "access.json"
    document = json.loads(access.read_text()) | {"peers": ["payload.blimp-2"]}
    access.write_text(json.dumps(document))
    with pytest.raises(TelemetryError, match="talks to a ground only"):
        credentials.load(access.parent)


def test_openssh_reads_the_ssh_key(authority: Authority) -> None:
    key = authority.of("payload.blimp-1") / "ssh_ed25519"
    try:
        shown = subprocess.run(
            ["ssh-keygen", "-y", "-f", str(key)], capture_output=True, text=True, check=True
        )
    except FileNotFoundError:
        pytest.skip("ssh-keygen is missing")
    assert shown.stdout.split()[:2] == key.with_suffix(".pub").read_text().split()[:2]


Act = Callable[[Authority], object]


@pytest.mark.parametrize(
    "act",
    [
        lambda authority: authority.add("payload", "blimp-2"),
        lambda authority: authority.add("ground", "spare"),
        lambda authority: authority.revoke("payload.blimp-1"),
        lambda authority: authority.renew("payload.blimp-1"),
        lambda authority: authority.rotate(),
    ],
    ids=["payload", "ground", "revoke", "renew", "rotate"],
)
def test_what_was_cut_short_is_done_again(tmp_path: Path, act: Act) -> None:
    clean, folder = tmp_path / "clean", tmp_path / "keys"
    made = Authority.create(clean)
    made.add("ground", "main")
    made.add("payload", "blimp-1")
    done, changes = False, 0
    while not done:
        shutil.copytree(clean, folder)
        with cut_after(changes):
            try:
                act(Authority(folder))
                done = True
            except PowerCut:
                pass
        if not done:
            before = set(Authority(folder).live())
            try:
                act(Authority(folder))
            except KeysError as error:  # it was whole already, and says so
                assert re.search("exists already|revoked already", str(error))
                assert before != {"ground.main", "payload.blimp-1"}
        assert Authority(folder).check(NOW) == [], changes
        shutil.rmtree(folder)
        changes += 13
    assert changes > 40


def test_an_authority_that_was_cut_short_is_made_again(tmp_path: Path) -> None:
    for changes in range(0, 24, 5):
        with cut_after(changes), pytest.raises(PowerCut):
            Authority.create(tmp_path / f"{changes}")
        Authority.create(tmp_path / f"{changes}").add("ground", "main")
        assert Authority(tmp_path / f"{changes}").check(NOW) == []


def test_a_folder_that_an_older_program_left_half_is_made_again(authority: Authority) -> None:
    half = authority.of("payload.blimp-3")
    half.mkdir()
    (half / "ssh_ed25519").touch()
    authority.add("payload", "blimp-3")
    assert Authority(authority.folder).check(NOW) == []


def test_a_member_is_renewed_and_keeps_its_other_keys(authority: Authority) -> None:
    def files() -> dict[str, bytes]:
        return {p.name: p.read_bytes() for p in authority.of("payload.blimp-1").iterdir()}

    before = files()
    assert main(["keys", "--folder", str(authority.folder), "renew", "payload.blimp-1"]) == 0
    changed = {name for name, data in files().items() if data != before[name]}
    assert changed == {"certificate.pem", "key.pem"}
    assert Authority(authority.folder).check(NOW) == []
    authority.revoke("payload.blimp-2")
    for name in ("payload.blimp-2", "payload.none"):
        with pytest.raises(KeysError, match="no such member, or revoked"):
            authority.renew(name)


def test_one_program_at_a_time_changes_an_authority(
    authority: Authority, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("ground_station.keys.authority._LOCK_S", 0.0)
    command = ["keys", "--folder", str(authority.folder), "ground", "spare"]
    with alone(authority.folder):
        assert main(command) == 2
    assert "another 'blimp keys' is at work" in capsys.readouterr().err
    assert main(command) == 0


def test_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    base = ["keys", "--folder", str(tmp_path / "k")]
    assert main([*base, "list"]) == 2
    assert "make one: blimp keys init" in capsys.readouterr().err
    assert main([*base, "init"]) == main([*base, "ground", "main"]) == 0
    assert main([*base, "payload", "blimp-1", "--days", "20"]) == 0
    assert main([*base, "check"]) == 1
    assert "payload.blimp-1: ends on" in capsys.readouterr().out
    assert main([*base, "payload", "../x"]) == main([*base, "init"]) == 2
    assert main([*base, "revoke", "payload.blimp-1"]) == main([*base, "check"]) == 0
    assert main([*base, "list"]) == 0
    assert "payload.blimp-1  revoked" in capsys.readouterr().out
    assert main([*base, "payload", "b", "--days", "0"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
