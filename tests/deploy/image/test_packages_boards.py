"""A board's data is checked by name, and holds what the firmware imports and plays through."""

from __future__ import annotations

import ast
import importlib.util
import re
import shutil
import sys
from fnmatch import fnmatchcase
from pathlib import Path

import pytest

from deploy.errors import DeployError
from deploy.image.packages.board import BOARDS_FOLDER, load_board, with_archives
from deploy.run import run

_FIRMWARE = Path(__file__).parents[3] / "pi_firmware"
_BOARDS = ("qemu", "zero2w", "zerow")

# Which package of Debian, or else which distribution of the lock, brings a module.
_BROUGHT_BY = {
    "cryptography": "python3-cryptography",
    "foxglove_schemas_protobuf": "foxglove-schemas-protobuf",
    "gi": "python3-gi",
    "google": "protobuf",
    "lz4": "python3-lz4",
    "mcap": "mcap",
    "numpy": "python3-numpy",
    "pymavlink": "pymavlink",
    "serial": "python3-serial",
    "smbus2": "python3-smbus2",
    "zenoh": "eclipse-zenoh",
    "zstandard": "python3-zstandard",
}
# Plays recordings on a desk and would bring 100 MB more; a card has another decoder.
_NOT_ON_A_CARD = {"avdec_h264"}
# Words of the firmware's that happen to be elements, too: a test picture, a speed.
_WORDS = {"smpte", "speed"}


@pytest.mark.parametrize("name", _BOARDS)
def test_a_card_holds_every_module_that_the_firmware_imports(name: str) -> None:
    board = load_board(name)
    held = {*board.package_names, *(wheel.name for wheel in board.wheels)}
    imported: set[str] = set()
    for file in _FIRMWARE.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import):
                imported |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                imported.add(node.module.split(".")[0])
    others = imported - set(sys.stdlib_module_names) - {"pi_firmware"}
    assert "zenoh" in others and "gi" in others
    assert {module: _BROUGHT_BY.get(module) in held for module in others} == dict.fromkeys(
        others, True
    )


def test_the_files_kept_of_mavlink_speak_it_alone(tmp_path: Path) -> None:
    wheel = next(wheel for wheel in load_board("qemu").wheels if wheel.name == "pymavlink")
    (place,) = importlib.util.find_spec("pymavlink").submodule_search_locations  # type: ignore
    installed = Path(place).parent
    for file in (installed / "pymavlink").rglob("*.py"):
        name = file.relative_to(installed).as_posix()
        if any(fnmatchcase(name, pattern) for pattern in wheel.keep):
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(file, tmp_path / name)
    program = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n"
        "from pymavlink.dialects.v20 import common\n"
        "link = common.MAVLink(None, srcSystem=1)\n"
        "data = common.MAVLink_heartbeat_message(1, 2, 3, 4, 5, 6).pack(link)\n"
        "print(common.MAVLink(None).parse_buffer(bytearray(data))[0].get_type())\n"
    )
    # -I -S: nothing of what is installed here helps it.
    assert run([sys.executable, "-I", "-S", "-c", program]) == b"HEARTBEAT\n"


def test_every_gstreamer_element_of_the_firmware_stays_on_the_card() -> None:
    gi = pytest.importorskip("gi")
    gi.require_version("Gst", "1.0")
    from gi.repository import Gst

    Gst.init(None)
    words: set[str] = set()
    for file in _FIRMWARE.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                words |= set(re.findall(r"(?:^|! )([a-z][a-z0-9]+)(?= |$)", node.value))
    rules = [name for group in load_board("qemu").left_out for name in group.names]
    gone = set()
    plugins = set()
    for word in words:
        factory = Gst.ElementFactory.find(word)
        plugin = factory.get_plugin() if factory is not None else None
        if plugin is None or not plugin.get_filename():
            continue
        file_name = f"/usr/lib/aarch64-linux-gnu/gstreamer-1.0/{Path(plugin.get_filename()).name}"
        plugins.add(word)
        verdicts = [rule for rule in rules if fnmatchcase(file_name, rule.removeprefix("!"))]
        if verdicts and not verdicts[-1].startswith("!"):
            gone.add(word)
    assert {"x264enc", "appsink", "videotestsrc", "h264parse"} <= plugins
    assert gone - _WORDS <= _NOT_ON_A_CARD


_QEMU = (BOARDS_FOLDER / "qemu.toml").read_text()


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ('machine = "aarch64"', "", "machine: Field required"),
        (_QEMU[_QEMU.index("[kernel]") :], "", "'kernel' stands exactly where"),
        ('image = "vmlinuz"', "", "kernel.image: Field required"),
        ('names = ["v4l-utils"]', "", ".names: Field required"),
        ('machine = "', 'colour = "red"\nmachine = "', "colour: Unexpected keyword argument"),
        ('"v4l-utils"', "5", "names.0: Input should be a valid string"),
        ("[kernel]", "[kernel", "own.toml: "),
    ],
)
def test_a_key_that_is_missing_or_wrong_is_named(
    tmp_path: Path, old: str, new: str, complaint: str
) -> None:
    assert old in _QEMU
    text = _QEMU.replace(old, new, 1).replace('"parts/', f'"{BOARDS_FOLDER}/parts/')
    (tmp_path / "own.toml").write_text(text)
    with pytest.raises(DeployError, match=re.escape(complaint)):
        load_board(tmp_path / "own.toml")


def test_an_unknown_board_and_an_unknown_archive_are_named() -> None:
    with pytest.raises(DeployError, match="board zero3: there are qemu, zero2w, zerow"):
        load_board("zero3")
    with pytest.raises(DeployError, match="has no archive 'pi': there are debian"):
        with_archives(load_board("qemu"), {"pi": {"url": "http://x"}})
    moved = with_archives(load_board("zero2w"), {"raspberrypi": {"url": "http://mirror/pi"}})
    assert moved.archives[2].url == "http://mirror/pi"
    assert moved.archives[2].only == load_board("zero2w").archives[2].only
