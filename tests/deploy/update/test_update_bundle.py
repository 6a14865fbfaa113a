"""What a card reads of a bundle: plain files that a signed list names, and nothing else."""

import io
import json
import tarfile
from pathlib import Path
from typing import Any

import pytest
from card_parts import commit, git
from card_stand import NEW, contents, lay, tar_of
from hypothesis import given
from hypothesis import strategies as st

from deploy.board.releases import manifest, receive
from deploy.board.releases.manifest import Release
from deploy.errors import DeployError
from deploy.update import bundle as bundles


def read(data: bytes) -> list[tuple[str, bytes]]:
    return [(m.name, b"".join(m.chunks())) for m in receive.members(io.BytesIO(data))]


def tar(*members: tarfile.TarInfo | str, format: int = tarfile.USTAR_FORMAT) -> bytes:
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w", format=format) as writer:
        for member in members:
            if isinstance(member, str):
                member = tarfile.TarInfo(member)
            writer.addfile(member, io.BytesIO(b"x" * member.size))
    return out.getvalue()


def kind(type_: bytes, link: str = "") -> tarfile.TarInfo:
    member = tarfile.TarInfo("pi_firmware/x")
    member.type, member.linkname = type_, link
    return member


def test_the_reader_agrees_with_pythons_writer() -> None:
    deep = "site/" + "/".join(["a" * 30] * 6) + ".py"
    files = {"a": b"", "b/c": b"x" * 511, "d": b"y" * 512, "e": b"z" * 513, deep: b"!" * 100_000}
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w|", format=tarfile.USTAR_FORMAT) as writer:
        for name, data in files.items():
            member = tarfile.TarInfo(name)
            member.size = len(data)
            writer.addfile(member, io.BytesIO(data))
    assert dict(read(out.getvalue())) == files


def with_mode(mode: int) -> tarfile.TarInfo:
    member = tarfile.TarInfo("pi_firmware/x")
    member.mode = mode
    return member


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (tar(kind(tarfile.SYMTYPE, "/etc/shadow")), "no plain file"),
        (tar(kind(tarfile.LNKTYPE, "/etc/shadow")), "no plain file"),
        (tar(kind(tarfile.CHRTYPE)), "no plain file"),
        (tar(kind(tarfile.BLKTYPE)), "no plain file"),
        (tar(kind(tarfile.FIFOTYPE)), "no plain file"),
        (tar(kind(tarfile.DIRTYPE)), "no plain file"),
        (tar(kind(tarfile.CONTTYPE)), "no plain file"),
        (tar(with_mode(0o4755)), "mode bits 4000"),
        (tar(with_mode(0o2755)), "mode bits 2000"),
        (tar("x" * 300, format=tarfile.GNU_FORMAT), "not a plain tar"),
        (tar("x" * 300, format=tarfile.PAX_FORMAT), "no plain file"),
        (tar("pi_firmware/x")[:700], "is cut"),
        (b"", "is cut"),
        (b"\0" * 512, "is cut"),
        (b"\0" * 512 + b"x" * 512, "its end is not one"),
        (b"PK\x03\x04" * 200, "not a plain tar"),
    ],
)
def test_what_is_no_plain_file_is_refused(data: bytes, said: str) -> None:
    with pytest.raises(DeployError, match=said) as caught:
        read(data)
    assert "\n" not in str(caught.value)


@given(st.integers(0, 511), st.integers(1, 255))
def test_no_changed_byte_of_a_header_goes_unseen(at: int, change: int) -> None:
    good = tar("pi_firmware/x")
    bad = bytearray(good)
    bad[at] ^= change
    try:
        names = [name for name, _ in read(bytes(bad))]
    except DeployError:
        return
    # Only the sum's own spelling may differ, as '\0' and ' ' behind its digits.
    assert names == ["pi_firmware/x"] and 148 <= at < 156


def listed(**changes: Any) -> bytes:
    files = [["pi_firmware/__main__.py", 1, "0" * 64]]
    document = {
        "schema": manifest.SCHEMA,
        "release": json.loads(contents(NEW)["release.json"]),
        "replaces": "",
        "files": files,
    }
    return json.dumps(document | changes).encode()


def entry(path: Any, size: Any = 1, sha256: Any = "0" * 64) -> bytes:
    files = [["pi_firmware/__main__.py", 1, "0" * 64], [path, size, sha256]]
    return listed(files=sorted(files, key=lambda one: str(one[0])))


def with_release(**changes: Any) -> bytes:
    return listed(release=json.loads(contents(NEW)["release.json"]) | changes)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "not JSON"),
        (b"[" * 99_999, "not JSON"),
        (b"[]", "not of schema"),
        (b" " * (manifest.MOST_BYTES + 1), "allowed"),
        (listed(schema="blimp.bundle/2"), "not of schema"),
        (listed(files={}), "lacks"),
        (listed(replaces=None), "lacks"),
        (listed(files=[]), "no firmware"),
        (listed(files=[["pi_firmware/__main__.py", 1]]), "the entry"),
        *((entry(path), "no path of a release") for path in (
            "../x", "/etc/passwd", "pi_firmware/../../x", "pi_firmware//x", "pi_firmware/./x",
            "site/", "site", "data/x", "manifest.json", "pi_firmware/a\\b", "pi_firmware/a\nb",
            "pi_firmware/" + "x" * 300, 7, None,
        )),
        (entry("pi_firmware/__main__.py"), "twice"),
        (entry("pi_firmware/__main__.py/x"), "as file and as folder"),
        (entry("site/x", -1), "with -1 bytes"),
        (entry("site/x", True), "with True bytes"),
        (entry("site/x", 1.5), "with 1.5 bytes"),
        (entry("site/x", manifest.MOST_CONTENT_BYTES), "allowed: 536870912"),
        (entry("site/x", 1, "G" * 64), "without a SHA-256"),
        (listed(files=[["pi_firmware/__main__.py", 1, "0" * 64], ["pi_firmware/A", 1, "0" * 64]]),
         "not in order"),
        (listed(files=[["pi_firmware/__main__.py", 1, "0" * 64]] * 20_001), "20001 files"),
        *((with_release(version=version), "'version' is") for version in (
            "", "1", "a.b", "1.0+a..b", "1.0+a.part", "1.0-2", "1.0/../x", "01.0", "1.0+", "1.0+A",
            "1." + "9" * 99, 3, None,
        )),
        (with_release(made="yesterday"), "'made' is"),
        (with_release(machine="a b"), "'machine' is"),
        (with_release(schema="x"), "not of schema"),
    ],
)  # fmt: skip
def test_a_list_that_may_not_be_is_refused(data: bytes, said: str) -> None:
    with pytest.raises(DeployError, match=said) as caught:
        manifest.parse(data)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("older", "newer"),
    [
        ("0.9.0", "0.10.0"),
        ("0.1", "0.1.1"),
        ("1.9.9.9", "2.0"),
        ("0.1.0+gitfff", "0.1.1+git000"),
    ],
)
def test_versions_compare_by_their_numbers(older: str, newer: str) -> None:
    made = "2026-01-01T00:00:00Z"
    later = "2027-01-01T00:00:00Z"  # of the older one: a number counts more than a date
    assert Release(older, "a", "b", later).age < Release(newer, "a", "b", made).age


def test_commits_of_one_version_compare_by_their_time() -> None:
    first = Release("0.1.0+gitfff", "a", "b", "2026-01-01T00:00:00Z")
    then = Release("0.1.0+git000", "a", "b", "2026-01-01T00:00:01Z")
    assert first.age < then.age
    assert Release("0.1", "a", "b", then.made).age == Release("0.1.0+x", "a", "b", then.made).age


def test_the_same_release_and_key_give_the_same_bytes(release_key: Path) -> None:
    files = contents(NEW)
    turned = dict(reversed(list(files.items())))
    one, two = (tar_of(bundles.make(made, release_key)) for made in (files, turned))
    assert one == two
    assert [name for name, _ in read(one)] == ["manifest.json", "manifest.json.sig", *sorted(files)]


def test_a_release_is_what_git_tracks_and_what_no_commit_holds_a_version_of_its_own(
    tmp_path: Path, release_key: Path
) -> None:
    program = tmp_path / "pi_firmware/__main__.py"
    project = b'[project]\nversion = "0.3.0"\n'
    lay(tmp_path, {"pi_firmware/__main__.py": b"print(1)\n", "pyproject.toml": project})
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", "-A")
    commit(tmp_path)
    (tmp_path / "pi_firmware/untracked.py").touch()

    def release() -> dict[str, str]:
        files = bundles.release_of(tmp_path, None, "aarch64", "3.13")
        assert set(files) == {"pi_firmware/__main__.py", "release.json"}
        told: dict[str, str] = json.loads(files["release.json"])
        manifest.parse(bundles.make(contents(told["version"]), release_key).manifest)
        return told

    told = release()
    assert told["version"] == f"0.3.0+git{git(tmp_path, 'rev-parse', 'HEAD')[:12]}"
    assert (told["machine"], told["made"]) == ("aarch64", "2025-10-09T08:53:20Z")
    program.write_text("print(2)\n")
    one, again = release(), release()
    program.write_text("print(3)\n")
    other = release()
    assert ".dirty." in one["version"] and one["version"] == again["version"] != other["version"]
    assert one["made"] > told["made"]
    assert manifest.read_release(one, "x").age <= manifest.read_release(other, "x").age
