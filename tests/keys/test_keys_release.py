"""The key that signs releases: made with the authority, rotated with it, given to each payload."""

import shutil
import subprocess
from pathlib import Path

import pytest

from ground_station.cli import main
from ground_station.errors import KeysError
from ground_station.keys.authority import Authority

NAMESPACE = "blimp-release"


def signers(authority: Authority) -> Path:
    return authority.of("payload.blimp-1") / "allowed_signers"


def signed(key: Path, namespace: str = NAMESPACE) -> Path:
    """A file's signature by OpenSSH itself; the file lies beside it."""
    text = key.parent / "text"
    text.write_text("a list")
    command = ["ssh-keygen", "-q", "-Y", "sign", "-f", key, "-n", namespace, text]
    signature = text.with_name("text.sig")
    signature.unlink(missing_ok=True)
    subprocess.run(command, check=True, capture_output=True, timeout=30)
    return signature


def is_trusted(trusting: Path, signature: Path) -> bool:
    command = ["ssh-keygen", "-Y", "verify", "-f", trusting, "-I", NAMESPACE, "-n", NAMESPACE]
    with (signature.parent / "text").open() as text:
        done = subprocess.run(
            [*command, "-s", signature], stdin=text, capture_output=True, timeout=30, check=False
        )
    return done.returncode == 0


def test_a_payload_trusts_what_its_authority_signs_and_nobody_else(
    authority: Authority, tmp_path: Path
) -> None:
    key, made = authority.release_key()
    assert not made and key.stat().st_mode & 0o777 == 0o600
    assert is_trusted(signers(authority), signed(key))
    assert not is_trusted(signers(authority), signed(key, "file"))
    stranger, _ = Authority.create(tmp_path / "other").release_key()
    assert not is_trusted(signers(authority), signed(stranger))
    # The payload's own SSH key signs no release.
    own = authority.of("payload.blimp-1") / "ssh_ed25519"
    assert not is_trusted(signers(authority), signed(own))


def test_a_rotation_keeps_neighbouring_steps_trusting(authority: Authority, tmp_path: Path) -> None:
    cards, keys = [], []
    for step in range(4):
        copy = tmp_path / f"card{step}"
        shutil.copy(signers(authority), copy)
        cards.append(copy)
        keys.append(authority.release_key()[0])
        if step < 3:
            authority.rotate()
    assert [key.name for key in keys] == ["1", "1", "2", "2"]
    for step, key in enumerate(keys):
        for card in cards[max(step - 1, 0) : step + 2]:
            assert is_trusted(card, signed(key)), (step, card)
    assert not is_trusted(cards[3], signed(keys[0]))


def test_an_authority_from_before_releases_gets_its_key(
    authority: Authority, capsys: pytest.CaptureFixture[str]
) -> None:
    import datetime

    now = datetime.datetime.now(datetime.UTC)
    shutil.rmtree(authority.folder / "releases")
    signers(authority).unlink()
    assert Authority(authority.folder).check(now) == [
        "payload.blimp-1: takes no releases of this authority; 'release' fixes it"
    ]
    assert not (authority.folder / "releases").exists()  # who checks changes nothing
    folder = ["--folder", str(authority.folder)]
    assert main(["keys", *folder, "release"]) == 0
    said = capsys.readouterr()
    key = Path(said.out.strip())
    assert said.err.count("\n") == 1 and "copy the payloads' folders" in said.err
    assert is_trusted(signers(authority), signed(key))
    assert main(["keys", *folder, "release"]) == 0
    again = capsys.readouterr()
    assert (again.out, again.err) == (said.out, "")


def test_a_signing_key_that_was_taken_away_is_not_replaced(authority: Authority) -> None:
    key, _ = authority.release_key()
    before = signers(authority).read_bytes()
    key.unlink()
    with pytest.raises(KeysError, match="bring it back"):
        authority.release_key()
    assert signers(authority).read_bytes() == before
