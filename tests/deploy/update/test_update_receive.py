"""A card takes a good bundle whole; any other one, a full card or a power cut leaves it sound."""

import errno
import io
import json
import os
import shutil
import stat
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from card_stand import NEW, NOW, OLD, Card, contents, lay, make_key, tar_of
from power import PowerCut, cut_after

from deploy.board.releases import receive, shelf, watch
from deploy.board.releases.choose import Choice, size_fault
from deploy.errors import DeployError
from deploy.update import bundle as bundles


def test_a_good_bundle_is_on_trial(card: Card) -> None:
    answer = card.take(card.bundle(contents(NEW)))
    assert answer["version"] == NEW and len(answer["id"]) == 16
    folder = card.at.folder(NEW)
    assert {name: (folder / name).read_bytes() for name in contents(NEW)} == contents(NEW)
    modes = {stat.S_IMODE(path.stat().st_mode) for path in folder.rglob("*") if path.is_file()}
    assert modes == {0o644}
    assert card.names() == {NEW, "current", "trial.json"} and card.service.watched == 1
    assert card.choice() == Choice(NEW, "update")
    # A board's slow processor compiles once, and not at each start.
    assert list((folder / "pi_firmware/__pycache__").glob("__main__.*.pyc"))
    with pytest.raises(DeployError, match="still on trial"):
        card.take(card.bundle(contents(NEW)))


def test_what_the_card_has_need_not_be_sent(card: Card) -> None:
    held = receive.holds(card.at)
    whole = bundles.make(contents(NEW), card.key)
    small = tar_of(whole, held)
    assert len(tar_of(whole)) - len(small) >= len(contents(NEW)["site/native.so"])
    card.take(small)
    assert (card.at.folder(NEW) / "site/native.so").read_bytes() == contents(NEW)["site/native.so"]
    # And once more, from a release that an update brought.
    assert receive.holds(card.at).keys() == contents(NEW).keys()


def refused(card: Card, data: bytes, said: str) -> None:
    before = card.names()
    with pytest.raises(DeployError, match=said) as caught:
        card.take(data)
    assert "\n" not in str(caught.value)
    assert card.names() == before and card.service.restarts == card.service.watched == 0
    assert card.choice() == Choice("", "factory")


def test_a_wrong_signature_is_refused(card: Card, tmp_path: Path) -> None:
    stranger = make_key(tmp_path / "stranger")
    refused(card, tar_of(bundles.make(contents(NEW), stranger)), "of no release key")
    good, other = (bundles.make(contents(v), card.key) for v in (NEW, "0.9.0+gitother"))
    swapped = bundles.Bundle(other.listed, other.manifest, good.signature, other.files)
    refused(card, tar_of(swapped), "of no release key")
    for signature in (b"", b"-----BEGIN SSH SIGNATURE-----\n", b"\xff" * 100):
        nonsense = bundles.Bundle(good.listed, good.manifest, signature, good.files)
        refused(card, tar_of(nonsense), "of no release key")
    long = bundles.Bundle(good.listed, good.manifest, b"x" * 9000, good.files)
    refused(card, tar_of(long), "allowed: 8192")


def test_an_armed_vehicle_takes_an_update_only_when_forced(card: Card) -> None:
    disarmed = card.service.now
    card.service.now = disarmed._replace(armed=True)
    refused(card, card.bundle(contents(NEW)), "armed: disarm it, or say --force")
    looks = iter((disarmed, card.service.now))
    card.service.seen = lambda: next(looks)  # type: ignore[method-assign]  # armed while it came
    refused(card, card.bundle(contents(NEW)), "armed")
    del card.service.seen
    stream = io.BytesIO(card.bundle(contents(NEW)))
    assert receive.receive(card.at, stream, card.service, force=True)["version"] == NEW  # type: ignore[arg-type]


def test_a_signature_for_something_else_is_refused(card: Card, tmp_path: Path) -> None:
    good = bundles.make(contents(NEW), card.key)
    path = tmp_path / "manifest.json"
    path.write_bytes(good.manifest)
    command = ["ssh-keygen", "-q", "-Y", "sign", "-f", str(card.key), "-n", "file", str(path)]
    subprocess.run(command, check=True, timeout=30)
    signature = (tmp_path / "manifest.json.sig").read_bytes()
    other = bundles.Bundle(good.listed, good.manifest, signature, good.files)
    refused(card, tar_of(other), "of no release key")


def test_a_card_without_a_release_key_says_what_to_do(card: Card) -> None:
    card.at.signers.unlink()
    refused(card, card.bundle(contents(NEW)), "trusts no release key .*blimp keys release")


@pytest.mark.parametrize("at", [0, 1, 511, 512, 700, 2048, 4000, 6000, 9000, 12_000, 16_000])
def test_a_cut_bundle_is_refused(card: Card, at: int) -> None:
    whole = card.bundle(contents(NEW))
    assert len(whole.rstrip(b"\0")) > 16_000
    refused(card, whole[:at], "is cut")


def test_a_changed_file_is_refused(card: Card) -> None:
    whole = card.bundle(contents(NEW))
    at = whole.index(contents(NEW)["site/native.so"]) + 5000
    changed = bytearray(whole)
    changed[at] ^= 1
    refused(card, bytes(changed), "site/native.so is not the file that its list tells")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda files: files | {"site/native.so": b""}, "not the file"),
        (lambda files: files | {"site/native.so": files["site/native.so"] + b"x"}, "not the file"),
        (lambda files: files | {"site/z.py": b""}, "'site/z.py', which its list lacks"),
        (lambda files: files | {"../../x": b""}, "which its list lacks|lacks pi_firmware"),
        (lambda files: files | {"release.json": files["release.json"] + b" "}, "not the file"),
        (lambda files: {n: d for n, d in files.items() if "native" not in n}, "in force"),
    ],
)
def test_files_other_than_the_list_are_refused(
    card: Card, change: Callable[[dict[str, bytes]], dict[str, bytes]], said: str
) -> None:
    """The list is signed; what follows it is not."""
    import tarfile

    good = bundles.make(contents(NEW), card.key)
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w|", format=tarfile.USTAR_FORMAT) as tar:
        extra = {"manifest.json": good.manifest, "manifest.json.sig": good.signature}
        sent = change(dict(good.files))
        for name in [*extra, *sorted(sent)]:
            data = {**sent, **extra}[name]
            member = tarfile.TarInfo(name)
            member.size = len(data)
            tar.addfile(member, io.BytesIO(data))
    if said == "in force":  # what the card has may be left out
        assert card.take(out.getvalue())["version"] == NEW
        return
    refused(card, out.getvalue(), said)
    assert not (card.root / "x").exists() and not (card.at.releases.parent / "x").exists()


def test_an_older_version_is_refused_and_a_signed_word_lets_it_in(card: Card) -> None:
    refused(card, card.bundle(contents(OLD)), "01-01T00:00:00Z is older than 0.2.0")
    refused(card, card.bundle(contents(OLD), replaces=NEW), "is older than")
    assert card.take(card.bundle(contents(OLD), replaces=NOW))["version"] == OLD


def test_another_machines_bundle_is_refused(card: Card) -> None:
    for other, said in (
        ({"machine": "armv6l"}, "for machine armv6l, this card's is aarch64"),
        ({"python": "3.11"}, "for python 3.11, this card's is 3.13"),
    ):
        refused(card, card.bundle(contents(NEW, **other)), said)


def test_the_version_that_runs_is_in_force_already(card: Card) -> None:
    assert card.take(card.bundle(contents(NOW))) == {"version": NOW, "id": ""}
    other = contents(NOW, {"pi_firmware/more.py": b""})
    refused(card, card.bundle(other), "runs already, with another pi_firmware/more.py")


def test_a_release_json_beside_the_list_is_refused(card: Card) -> None:
    """The list says one version to the checks, and the file another to all that comes after."""
    files = contents(NEW)
    made = bundles.make(files, card.key)
    document = json.loads(made.manifest)
    document["release"]["version"] = "9.0.0"
    data = json.dumps(document).encode()
    signed = bundles.Bundle(made.listed, data, bundles.sign(data, card.key), files)
    refused(card, tar_of(signed), "is not the one that its list tells")


def test_a_card_without_room_is_left_as_it_was(card: Card, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(receive, "_free", lambda at: 1_000_000)
    refused(card, card.bundle(contents(NEW)), "4 MB are needed and 1 MB free; delete recordings")


def test_the_release_before_the_last_makes_room(
    card: Card, monkeypatch: pytest.MonkeyPatch
) -> None:
    for version in (NEW, "0.3.0"):
        healthy(card, card.bundle(contents(version)))
    assert card.names() == {NEW, "0.3.0", "current", "previous"}
    monkeypatch.setattr(receive, "_free", lambda at: 1 << 30 if len(card.names()) < 4 else 0)
    card.take(card.bundle(contents("0.4.0")))
    assert card.names() == {"0.3.0", "0.4.0", "current", "trial.json"}


def healthy(card: Card, data: bytes) -> None:
    card.take(data)
    card.service.on_restart = card.start
    watch.watch(card.at, card.service, lambda line: None, lambda s: None)  # type: ignore[arg-type]
    assert json.loads(card.at.last.read_text())["outcome"] == "healthy"


@pytest.mark.parametrize("fault", [errno.ENOSPC, errno.EIO])
def test_a_disk_that_fails_in_the_midst_is_one_line(
    card: Card, fault: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def sync() -> None:
        raise OSError(fault, os.strerror(fault), "x")

    monkeypatch.setattr(os, "sync", sync)
    refused(card, card.bundle(contents(NEW)), os.strerror(fault))


def test_a_disk_that_is_really_full_is_one_line(
    card: Card, monkeypatch: pytest.MonkeyPatch
) -> None:
    if os.geteuid() != 0:
        pytest.skip("mounting a small tmpfs needs root")
    where = str(card.at.releases)
    mount = ["mount", "-t", "tmpfs", "-o", "size=200k", "tmpfs", where]
    if subprocess.run(mount, capture_output=True, check=False, timeout=30).returncode != 0:
        pytest.skip("no tmpfs can be mounted here")
    try:
        monkeypatch.setattr(receive, "_free", lambda at: 1 << 30)  # as if it filled up meanwhile
        big = contents(NEW, {"site/big": os.urandom(400_000)})
        refused(card, card.bundle(big), "No space left on device")
        assert card.names() == set()
    finally:
        subprocess.run(["umount", where], check=True, timeout=30)


def test_a_card_that_reads_back_other_bytes_is_not_switched(
    card: Card, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = os.sync

    def sync() -> None:
        real()
        for path in card.at.releases.glob("*.part/site/native.so"):
            path.write_bytes(b"\xff" * path.stat().st_size)

    monkeypatch.setattr(os, "sync", sync)
    refused(card, card.bundle(contents(NEW)), "the card reads other bytes")


def sound(card: Card) -> Choice:
    """A start finds a release that is whole, with or without a reason to tell."""
    chosen = card.start()
    if chosen.name:
        folder = card.at.folder(chosen.name)
        listed = receive.manifest.parse((folder / "manifest.json").read_bytes())
        assert size_fault(card.at, chosen.name) == shelf.hash_fault(folder, listed) == ""
    return chosen


def test_power_may_go_at_every_change_of_an_update(
    card: Card, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From a release of an update to the next one: after each cut one of both runs, and goes on."""
    healthy(card, card.bundle(contents(NEW)))
    newer = card.bundle(contents("0.3.0"))
    monkeypatch.setattr(receive.manifest, "verify", lambda *given: None)  # it changes nothing
    clean = tmp_path / "clean"
    shutil.copytree(card.root, clean, symlinks=True)
    changes, seen = 0, set()
    while True:
        shutil.rmtree(card.root)
        shutil.copytree(clean, card.root, symlinks=True)
        with cut_after(changes) as supply:
            try:
                card.take(newer)
                done = True
            except PowerCut:
                done = False
        card.boot(f"boot-{changes + 2}")
        chosen = sound(card)
        seen.add(chosen.name)
        assert chosen.name in (NEW, "0.3.0")
        # The watcher of the new boot ends what was begun; then the same update comes whole.
        watch.watch(card.at, card.service, lambda line: None, lambda s: None)  # type: ignore[arg-type]
        assert not card.at.trial.exists()
        if card.at.linked("current") == NEW:
            healthy(card, newer)
        assert card.names() == {NEW, "0.3.0", "current", "previous"}
        assert sound(card) == Choice("0.3.0", "update")
        if done:
            break
        assert supply.changes == changes
        changes += 1
    assert changes > 20 and seen == {NEW, "0.3.0"}


def test_one_update_at_a_time(card: Card) -> None:
    with (
        shelf.lock(card.at),
        pytest.raises(DeployError, match="another update is under way"),
        shelf.lock(card.at, wait_s=0.3),
    ):
        pass


def test_what_was_half_written_goes_away(card: Card) -> None:
    lay(card.at.releases / "9.9.9.part", {"a/b": b""})
    lay(card.at.releases / "0.0.1", {"a/b": b""})
    (card.at.releases / "current.part").symlink_to("x")
    (card.at.releases / "trial.json.part").write_text("{")
    shelf.prune(card.at)
    assert card.names() == set()
