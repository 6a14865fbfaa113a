"""A configuration with each key wrong in turn: one line that names the key, and nothing starts."""

from __future__ import annotations

import dataclasses
import json
import math
import subprocess
import sys
import tomllib
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import tomli_w

from pi_firmware import settings
from pi_firmware.settings import Settings
from pi_firmware.wire.errors import ConfigError

SHIPPED = Path(settings.__file__).with_name("payload.toml")
OTHER_KINDS: dict[Any, list[Any]] = {
    float: ["fast", True, [1.0], {"m": 1.0}],
    int: ["many", 1.5, True, [1]],
    str: [7, True, ["test:"], {"uri": "test:"}],
    bool: [1, "true", 0.0],
    list: ["tcp/127.0.0.1:1", 3, {"a": 1}],
}
# What is refused for more than its type and its range, by what it says.
MEANINGS: dict[str, list[Any]] = {
    "payload_id": ["", "Blimp 1", "a/b", "-x", "b" * 33],
    "camera.uri": ["", "webcam:", "test:?pattern=cat", "test:?speed=1", "replay:"],
    "camera.width_px": [641],
    "camera.height_px": [481],
    "encoder.min_bitrate_kbps": [2001],
    "telemetry.connect": [["tcp/192.0.2.1:7447"], ["udp/127.0.0.1:1"], ["tcp/127.0.0.1:99999"]],
    "telemetry.listen": [["tcp/0.0.0.0:7447"], ["127.0.0.1"], ["tls/127.0.0.1:1"]],
    "battery.uri": ["", "i2c:", "i2c:bq27441@1:0x55", "i2c:ina219@1:0x36", "fake:?minutes=0"],
    "battery.critical_percentage": [0.25],
    "autopilot.uri": ["", "udp:1", "serial:", "serial:/dev/tty?baud=0"],
    "autopilot.mount_m": [[], [0.0, 0.0], [0.0, 0.0, 99.0]],
}


@dataclasses.dataclass(frozen=True)
class Key:
    """One key of the file: its place, its type and its bounds."""

    path: tuple[str, ...]
    kind: Any
    meta: typing.Mapping[str, Any]

    @property
    def name(self) -> str:
        """As a message names it."""
        return ".".join(self.path)

    def wrong(self) -> Iterator[Any]:
        """Values that this key must refuse."""
        kind = typing.get_origin(self.kind) or self.kind
        yield from OTHER_KINDS[kind]
        if kind is list:
            (item,) = typing.get_args(self.kind)
            yield from ([value] for value in OTHER_KINDS[item])
        low, high = self.meta["low"], self.meta["high"]
        step = 1 if kind is int else 1e-6
        if low is not None:
            yield from (kind(low - step), kind(-(10**9)))
        if high is not None:
            yield from (kind(high + step), kind(10**12))
        if kind is float:
            yield from (math.nan, math.inf, -math.inf)
        if self.meta["choices"]:
            yield from ("", "no-such-choice", str(self.meta["choices"][0]).upper())
        yield from MEANINGS.get(self.name, [])


def keys_of(cls: Any = Settings, prefix: tuple[str, ...] = ()) -> Iterator[Key]:
    """All keys of the payload's file."""
    hints = typing.get_type_hints(cls)
    for field in dataclasses.fields(cls):
        path = (*prefix, field.name)
        if dataclasses.is_dataclass(hints[field.name]):
            yield from keys_of(hints[field.name], path)
        else:
            yield Key(path, hints[field.name], field.metadata)


KEYS = list(keys_of())


def changed(path: tuple[str, ...], value: Any) -> dict[str, Any]:
    """The shipped file with one key set to a value."""
    document = tomllib.loads(SHIPPED.read_text())
    table = document
    for part in path[:-1]:
        table = table[part]
    table[path[-1]] = value
    return document


def write(folder: Path, name: str, path: tuple[str, ...], value: Any) -> Path:
    """The same as a file."""
    file = folder / f"{name}.toml"
    file.write_text(tomli_w.dumps(changed(path, value)))
    return file


@pytest.mark.parametrize("key", KEYS, ids=lambda key: key.name)
def test_each_wrong_value_of_each_key_is_one_line_that_names_it(key: Key, tmp_path: Path) -> None:
    neighbour = (*key.path[:-1], key.path[-1] + "_")
    wrong = [(key.path, value) for value in key.wrong()]
    wrong.append((neighbour, 1))
    for path, value in wrong:
        if key.name.endswith(".uri") and isinstance(value, str):
            continue  # opened later, by the program: see below
        file = write(tmp_path, "payload", path, value)
        with pytest.raises(ConfigError) as refused:
            settings.load(file)
        line = str(refused.value)
        assert "\n" not in line and len(line) < 1000
        assert ".".join(path) in line, (value, line)


def refusals() -> list[tuple[str, tuple[str, ...], Any]]:
    """For the program itself: one wrong value of each key, all of those with a meaning, and an
    unknown neighbour in each table."""
    cases: list[tuple[str, tuple[str, ...], Any]] = []
    for number, key in enumerate(KEYS):
        wrong = list(key.wrong())
        chosen = MEANINGS.get(key.name) or [wrong[number % len(wrong)]]
        cases += [(f"{key.name}-{i}", key.path, value) for i, value in enumerate(chosen)]
    tables = {key.path[:-1] for key in KEYS}
    cases += [("-".join(table) + "-unknown", (*table, "colour"), 1) for table in sorted(tables)]
    return cases


CASES = refusals()


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """The program with each of them."""
    folder = tmp_path_factory.mktemp("settings")
    files = [write(folder, str(i), *case[1:]) for i, case in enumerate(CASES)]
    commands = [json.dumps(["--config", str(file)]) for file in files]
    done = subprocess.run(
        [sys.executable, str(Path(__file__).with_name("many_starts.py"))],
        input="\n".join(commands),
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    lines = map(json.loads, done.stdout.splitlines())
    return dict(zip((case[0] for case in CASES), lines, strict=True))


@pytest.mark.parametrize(("name", "path", "value"), CASES, ids=[case[0] for case in CASES])
def test_the_program_refuses_it_and_starts_nothing(
    runs: dict[str, dict[str, Any]], name: str, path: tuple[str, ...], value: Any
) -> None:
    done = runs[name]
    assert done["status"] == 2, done["err"]
    assert done["out"] == ""  # not even its first line: nothing was opened
    assert done["err"].startswith("pi_firmware: ") and done["err"].count("\n") == 1
    assert ".".join(path) in done["err"]


@pytest.mark.parametrize("case", CASES[:: len(CASES) // 4], ids=lambda case: str(case[0]))
def test_started_alone_it_says_the_same(
    runs: dict[str, dict[str, Any]], case: tuple[str, tuple[str, ...], Any], tmp_path: Path
) -> None:
    command = [
        sys.executable,
        "-m",
        "pi_firmware",
        "--config",
        str(write(tmp_path, "payload", *case[1:])),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    found = {"status": done.returncode, "out": done.stdout, "err": done.stderr}
    said = dict(runs[case[0]])
    for run in (found, said):
        run["err"] = run["err"].partition(".toml")[2]  # the files are different ones
    assert found == said
