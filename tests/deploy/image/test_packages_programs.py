"""What a card's programs need is checked from their files, and how they are started here."""

from __future__ import annotations

import os
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from deploy.errors import DeployError
from deploy.image.packages import foreign
from deploy.image.packages.libraries import missing, needed
from deploy.image.packages.python import settle

_PROGRAM = Path("/bin/ls").resolve()


def _libraries(program: Path) -> list[Path]:
    """What the system's own loader finds for a program."""
    listed = subprocess.run(["ldd", str(program)], check=True, capture_output=True, text=True)
    paths = [line.split("=>")[1].split()[0] for line in listed.stdout.splitlines() if "=>" in line]
    return [Path(path) for path in paths]


def _named(root: Path, name: str) -> Path:
    return next(path for path in root.rglob("*") if path.name == name)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A root with one program and, by the way of links, all that it needs."""
    if shutil.which("ldd") is None or needed(_PROGRAM) is None:
        pytest.skip("needs a program that is linked with libraries, and ldd")
    folder = tmp_path / f"usr/lib/{os.uname().machine}-linux-gnu"
    folder.mkdir(parents=True)
    (tmp_path / "usr/bin").mkdir()
    shutil.copy(_PROGRAM, tmp_path / "usr/bin/ls")
    for library in _libraries(_PROGRAM):
        shutil.copy(library.resolve(), folder / f"{library.name}.real")
        (folder / library.name).symlink_to(f"/{folder.relative_to(tmp_path)}/{library.name}.real")
    return tmp_path


def test_a_program_names_the_libraries_that_the_loader_finds(root: Path) -> None:
    assert set(needed(_PROGRAM) or ()) <= {path.name for path in _libraries(_PROGRAM)} | {
        name for name in needed(_PROGRAM) or () if name.startswith("ld-linux")
    }
    assert missing(root) == []


def test_a_library_left_out_that_a_program_needs_is_told(root: Path) -> None:
    for library in _libraries(_PROGRAM):
        link = _named(root, library.name)
        link.unlink()
        assert any(line.endswith(f": {library.name}") for line in missing(root))
        assert all(line.startswith("/usr/bin/ls: ") for line in missing(root))
        link.symlink_to(f"{library.name}.real")
    script = [sys.executable, "-m", "deploy.image.packages.libraries", str(root)]
    assert subprocess.run(script, check=False).returncode == 0
    _named(root, "libc.so.6").unlink()
    done = subprocess.run(script, check=False, capture_output=True, text=True)
    assert done.returncode == 1 and "E: misses a library: /usr/bin/ls: libc.so.6" in done.stderr


def test_libraries_in_a_folder_of_the_program_s_own_are_found(root: Path) -> None:
    own = root / "usr/libexec/ls"
    own.mkdir(parents=True)
    for library in _libraries(_PROGRAM):
        link = _named(root, library.name)
        shutil.move(link.parent / f"{link.name}.real", own / link.name)
        link.unlink()
    assert missing(root) == []


def test_what_is_no_program_or_is_cut(tmp_path: Path) -> None:
    (tmp_path / "text").write_text("#!/bin/sh\n")
    assert needed(tmp_path / "text") is None
    (tmp_path / "empty").touch()
    assert needed(tmp_path / "empty") is None
    whole = _PROGRAM.read_bytes()
    for length in (20, 60, 300):
        (tmp_path / "cut").write_bytes(whole[:length])
        with pytest.raises(DeployError, match="cut or damaged"):
            needed(tmp_path / "cut")


def _fits(rule: bytes, header: bytes) -> bool:
    """How the kernel compares: where the mask has a bit, magic and file have the same one."""
    fields = rule.decode().split(":")
    magic, mask = (
        bytes(int(digits, 16) for digits in field.split("\\x")[1:]) for field in fields[4:6]
    )
    assert len(magic) == len(mask) == 20
    return all((have ^ want) & bits == 0 for have, want, bits in zip(header, magic, mask))  # noqa: B905


def test_the_rule_of_an_architecture_takes_its_programs_only() -> None:
    def header(elf_class: int, kind: int, machine: int, abi: int = 0) -> bytes:
        return struct.pack("<4sBBBB8xHH", b"\x7fELF", elf_class, 1, 1, abi, kind, machine)

    rule = foreign.elf_rule("qemu-aarch64", 2, 183, "/usr/bin/qemu-aarch64-static")
    assert rule.startswith(b":qemu-aarch64:M::") and b":/usr/bin/qemu-aarch64-static:" in rule
    # Fixed and relocatable programs, System V's and GNU's ABI.
    assert all(_fits(rule, header(2, kind, 183, abi)) for kind in (2, 3) for abi in (0, 3))
    # Another machine, another word size, an object file.
    assert not _fits(rule, header(2, 2, 62))
    assert not _fits(rule, header(1, 2, 40))
    assert not _fits(rule, header(2, 1, 183))
    arm = foreign.elf_rule("qemu-arm", 1, 40, "/usr/bin/qemu-arm-static")
    assert _fits(arm, header(1, 3, 40)) and not _fits(arm, header(2, 3, 183))


def test_an_architecture_is_native_or_emulated_or_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(foreign.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(foreign, "BINFMT", Path("/nonexistent"))
    monkeypatch.setattr(foreign, "need", lambda tool: f"/usr/bin/{tool}")
    assert foreign.prefix("amd64") == []
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    assert foreign.prefix("arm64")[-2:] == ["deploy.image.packages.foreign", "arm64"]
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    with pytest.raises(DeployError, match="programs of arm64 run here only as root"):
        foreign.prefix("arm64")
    with pytest.raises(DeployError, match="architecture riscv64: emulated are amd64, arm64"):
        foreign.prefix("riscv64")


def test_a_system_that_runs_them_itself_is_asked_for_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(foreign.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(foreign, "BINFMT", tmp_path)
    monkeypatch.setattr(foreign, "need", lambda tool: f"/usr/bin/{tool}")
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    rule = "enabled\ninterpreter /usr/libexec/qemu-binfmt/aarch64\nflags: POCF\noffset 0\n"
    (tmp_path / "qemu-aarch64").write_text(rule)
    assert foreign.prefix("arm64") == []
    # Without F, the emulator would have to lie inside the chroot.
    (tmp_path / "qemu-aarch64").write_text(rule.replace("POCF", "OC"))
    with pytest.raises(DeployError):
        foreign.prefix("arm64")


def test_byte_code_works_whatever_its_source_s_time_is(tmp_path: Path) -> None:
    package = tmp_path / "usr/lib/python3/dist-packages/thing"
    package.mkdir(parents=True)
    source = package / "__init__.py"
    source.write_text("ANSWER = 42\n")
    compile_it = [sys.executable, "-m", "compileall", "-q", str(package)]
    subprocess.run(compile_it, check=True)
    assert settle(tmp_path) == 1
    # Neither the source's time nor its content is looked at any more: the byte code is what runs.
    source.write_text("ANSWER = 7\n")
    os.utime(source, (1, 1))
    ran = subprocess.run(
        [sys.executable, "-c", "import thing; print(thing.ANSWER)"],
        env={**os.environ, "PYTHONPATH": str(package.parent)},
        check=True,
        capture_output=True,
    )
    assert ran.stdout == b"42\n"
