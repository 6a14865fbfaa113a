"""The shipped configuration says every key, unit, range and default, and bad values by name."""

import dataclasses
import tomllib
import typing
from collections.abc import Iterator
from pathlib import Path

import pytest

from pi_firmware import settings
from pi_firmware.wire.errors import ConfigError

SHIPPED = Path(settings.__file__).parent / "payload.toml"


def fields_of(kind: type, prefix: str = "") -> Iterator[tuple[str, dataclasses.Field]]:
    hints = typing.get_type_hints(kind)
    for field in dataclasses.fields(kind):
        if dataclasses.is_dataclass(hints[field.name]):
            yield from fields_of(hints[field.name], f"{field.name}.")
        else:
            yield prefix + field.name, field


def comments_above_keys() -> dict[str, str]:
    """Each key's nearest block of comments; keys in a row share it."""
    result, table, comment, after_key = {}, "", "", False
    for line in SHIPPED.read_text().splitlines():
        if line.startswith("["):
            table, comment = line.strip("[]") + ".", ""
        elif line.startswith("#"):
            comment = line if after_key else f"{comment} {line}"
            after_key = False
        elif "=" in line:
            result[table + line.split("=")[0].strip()] = comment
            after_key = True
    return result


def test_the_shipped_file_has_every_key_with_its_default() -> None:
    assert tomllib.loads(SHIPPED.read_text()) == dataclasses.asdict(settings.Settings())
    assert settings.load(SHIPPED) == settings.Settings()


def test_the_shipped_file_says_every_unit_and_range() -> None:
    comments = comments_above_keys()
    for name, field in fields_of(settings.Settings):
        meta = field.metadata
        said = [meta["unit"]] + [f"{b:.10g}" for b in (meta["low"], meta["high"]) if b is not None]
        said += list(meta["choices"] or [])
        assert comments[name], name
        for part in said:
            assert part in comments[name], f"{name}: '{part}' is not in its comment"


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("gate.min_entropy_bits=9", "'gate.min_entropy_bits' is 9.0; allowed: 0 to 8 bit"),
        ("gate.min_entropy_bits=nan", "finite"),
        ("gate.enabled=1", "true or false"),
        ("encoder.name=x265enc", "'x264enc', 'v4l2h264enc'"),
        ("camera.width_px=641", "even"),
        ("link.ports=1", "unknown key 'link.ports'"),
        ("link.port=0", "1 to 65535"),
        ("payload_id=A/b", "payload_id 'A/b'"),
        ("telemetry.connect=['tcp/10.0.0.1:7447']", "only loopback"),
        ("telemetry.listen=['udp/127.0.0.1:7447']", "expected tcp/HOST:PORT"),
        ("camera", "expected key=value"),
        ("payload_id.x=1", "not a table"),
        ("camera.rate_hz=fast", "'fast' is not a TOML value"),
        ("camera.exposure_s=2", "0 to 1 s"),
        ("camera.gain=-1", "0 to 1000"),
        ("camera.white_balance=moon", "'auto', 'incandescent'"),
        ("camera.focus_m=-1", "0 to 1000 m"),
        ("encoder.min_bitrate_kbps=3000", "must not be above"),
        ("battery.critical_percentage=0.3", "critical_percentage' is 0.3; it must be below"),
    ],
)
def test_a_bad_value_is_refused_in_one_line(override: str, named: str) -> None:
    given = ["payload_id=blimp-1", override]
    with pytest.raises(ConfigError) as caught:
        settings.load(None, given)
    assert named in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_override_wins_over_the_file_and_text_needs_no_quotes() -> None:
    loaded = settings.load(
        SHIPPED, ["camera.uri=replay:a b.mcap?loop=1", "payload_id=7", "camera.rate_hz=5"]
    )
    assert loaded.camera.uri == "replay:a b.mcap?loop=1"
    assert loaded.payload_id == "7"
    assert loaded.camera.rate_hz == 5.0
