"""Configuration files: what is refused, and by which name."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import pytest

from pi_firmware.wire import config
from pi_firmware.wire.errors import ConfigError


@dataclass(frozen=True)
class Radio:
    port: int = config.key(5600, "where video goes", low=1, high=65535)
    host: str = config.key("127.0.0.1", "whom to send to")


@dataclass(frozen=True)
class Settings:
    rate_hz: float = config.key(30.0, "frames a second", unit="Hz", low=1, high=120)
    encoder: str = config.key("x264", "which encoder", choices=["x264", "v4l2"])
    gate: bool = config.key(True, "whether to hold back bad frames")
    offsets_m: list[float] = config.key([0.0, 1.5], "places", unit="m", low=-10, high=10)
    words: list[str] = config.key([], "any words")
    limit: float | None = config.key(None, "nothing means no limit", low=0)
    radio: Radio = config.table(Radio)


@dataclass(frozen=True)
class Strict:
    name: str = field()
    count: int = config.key(1, "how many", low=0)

    def __post_init__(self) -> None:
        if self.name == "none" and self.count:
            raise ValueError("count must be 0 when name is 'none'")


def load(tmp_path: Path, text: str, cls: type = Settings) -> object:
    path = tmp_path / "c.toml"
    path.write_text(text)
    return config.load(path, cls)


def test_an_empty_file_gives_the_defaults(tmp_path: Path) -> None:
    assert load(tmp_path, "") == Settings()


def test_values_are_read_and_whole_numbers_serve_as_numbers(tmp_path: Path) -> None:
    text = "rate_hz = 5\nencoder = 'v4l2'\ngate = false\nlimit = 2\noffsets_m = [1, -2.5]\n"
    settings = load(tmp_path, text + "[radio]\nport = 1\n")
    assert settings == Settings(5.0, "v4l2", False, [1.0, -2.5], [], 2.0, Radio(port=1))
    assert isinstance(settings, Settings) and isinstance(settings.rate_hz, float)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("rate = 5", "unknown key 'rate' (known here: encoder, gate, limit, offsets_m, radio, "),
        ("[radio]\nprot = 5", "unknown key 'radio.prot' (known here: host, port)"),
        ("[extra]\na = 1", "unknown key 'extra'"),
        ('"a\\nb" = 1', r"unknown key 'a\nb'"),
        ("rate_hz = 0.5", "'rate_hz' is 0.5; allowed: 1 to 120 Hz"),
        ("rate_hz = 121", "'rate_hz' is 121.0; allowed: 1 to 120 Hz"),
        ("rate_hz = nan", "'rate_hz' must be a finite number, not nan"),
        ("rate_hz = -inf", "'rate_hz' must be a finite number, not -inf"),
        ("rate_hz = true", "'rate_hz' must be a number, not True"),
        ("rate_hz = '30'", "'rate_hz' must be a number, not '30'"),
        (f"rate_hz = {'9' * 400}", "'rate_hz' must be a finite number"),
        ("limit = -1", "'limit' is -1.0; allowed: 0 to inf"),
        ("gate = 1", "'gate' must be true or false, not 1"),
        ("encoder = 'nvenc'", "'encoder' is 'nvenc'; allowed: 'x264', 'v4l2'"),
        ("encoder = ['x264']", "'encoder' must be"),
        ("offsets_m = 1.0", "'offsets_m' must be a list, not 1.0"),
        ("offsets_m = [0.0, 11]", "'offsets_m'[1] is 11.0; allowed: -10 to 10 m"),
        ("offsets_m = [0.0, true]", "'offsets_m'[1] must be a number, not True"),
        ("offsets_m = [nan]", "'offsets_m'[0] must be a finite number"),
        ("words = [1]", "'words'[0] must be a string, not 1"),
        ("words = 'ab'", "'words' must be a list"),
        ("radio = 5600", "'radio' must be a table"),
        ("[radio]\nport = true", "'radio.port' must be a whole number, not True"),
        ("[radio]\nport = 5600.0", "'radio.port' must be a whole number, not 5600.0"),
        ("[radio]\nport = 0", "'radio.port' is 0; allowed: 1 to 65535"),
        (f"[radio]\nport = 0x{'F' * 5000}", "'radio.port' is a number of 20000 bits; allowed"),
        (f"[radio]\nhost = ['{'x' * 5000}']", "'radio.host' must be a string, not ['xxx"),
        ("rate_hz = ", "not valid TOML"),
        ("rate_hz = 5\nrate_hz = 6", "not valid TOML"),
        (f"rate_hz = {'9' * 5000}", "not valid TOML"),
        ("words = " + "[" * 3000, "not valid TOML"),
        (f"words = [0x{'F' * 5000}]", "'words'[0] must be a string, not a number of"),
        (f"words = [[0x{'F' * 5000}]]", "'words'[0] must be a string, not a list"),
        (f"encoder = {{{'a.' * 30}a = [{'[' * 300}{']' * 300}]}}", "'encoder' must be a string"),
        ("encoder" + ".a" * 60_000 + " = 1", "a key has more than 32 parts"),
        ("encoder" + ' . "a"' * 60_000 + " = 1", "a key has more than 32 parts"),
        (f"words = {{{'a.' * 60_000}a = 1}}", "a key has more than 32 parts"),
        ("rate_hz = 5 # " + "x" * 4_194_304, "more than 4194304 bytes"),
    ],
)
def test_what_is_wrong_is_named_in_one_line(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(ConfigError) as error:
        load(tmp_path, text)
    message = str(error.value)
    assert says in message and "c.toml" in message
    assert "\n" not in message and len(message) < 400


def test_what_is_no_table_at_all_is_named() -> None:
    with pytest.raises(ConfigError, match=r"^builds\.toml: conditions 'day' must be a table$"):
        config.from_mapping(5, Strict, where="builds.toml: conditions 'day'")  # type: ignore[arg-type]


def test_a_key_without_default_must_be_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="the key 'name' is missing"):
        load(tmp_path, "count = 2", Strict)


def test_a_cross_check_of_the_settings_names_the_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"c\.toml: count must be 0"):
        load(tmp_path, "name = 'none'", Strict)


def test_files_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    (tmp_path / "b.toml").write_bytes(b"\xff\xfe\x00")
    for name in ("missing.toml", "b.toml", "."):
        with pytest.raises(ConfigError, match=r"^[^\n]+$"):
            config.load(tmp_path / name, Settings)


@pytest.mark.parametrize(
    "override",
    ["rate_hz", "rate_hz=" + "[" * 3000, f"words=[0x{'F' * 5000}]", "rate_hz=" + "9" * 5000,
     "rate_hz" + ".a" * 3000 + "=1", "rate_hz=1\n\n="],
)  # fmt: skip
def test_an_override_that_cannot_be_is_refused_in_one_short_line(override: str) -> None:
    document: dict[str, object] = {"rate_hz": 5}
    with pytest.raises(ConfigError, match=r"^[^\n]{1,400}$"):
        config.apply_override(document, override, Settings)
        config.from_mapping(document, Settings)


def test_text_with_many_dots_is_no_deep_key(tmp_path: Path) -> None:
    words = ["a.b." * 10, "1.5, " * 100, "..." * 100, "a, " * 100]
    settings = load(tmp_path, f"words = {words}\noffsets_m = {[0.5] * 200}\n")
    assert isinstance(settings, Settings) and settings.words == words


def test_defaults_that_are_lists_are_not_shared() -> None:
    Settings().offsets_m.append(9.0)
    assert Settings().offsets_m == [0.0, 1.5]


def test_an_override_of_somebody_elses_document_takes_values_and_text() -> None:
    document: dict[str, object] = {"encoder": {"adapt": False}}
    for override in ("encoder.bitrate_kbps=800", "camera.uri=test:", "gate.enabled=false"):
        config.apply_override(document, override)
    assert document == {
        "encoder": {"adapt": False, "bitrate_kbps": 800},
        "camera": {"uri": "test:"},
        "gate": {"enabled": False},
    }
    with pytest.raises(ConfigError, match="expected key=value"):
        config.apply_override(document, "encoder")
