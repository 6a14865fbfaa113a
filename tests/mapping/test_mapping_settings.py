"""The shipped settings file documents the defaults, key for key."""

from __future__ import annotations

import dataclasses

import pytest

from ground_station.mapping.settings import SHIPPED, MappingSettings, load_settings
from pi_firmware.wire import config
from pi_firmware.wire.errors import ConfigError


def test_the_shipped_file_holds_every_key_with_its_default():
    assert load_settings() == MappingSettings()
    assert set(config.read(SHIPPED)) == {f.name for f in dataclasses.fields(MappingSettings)}
    for name in ("match", "sfm", "refine", "extend"):
        table = getattr(MappingSettings(), name)
        assert config.read(SHIPPED)[name] == dataclasses.asdict(table)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[match]\nratio = 1.5\n", "match.ratio.*1.5.*0.1 to 1"),
        ("colour = 1\n", "'colour'"),
        ("[sfm]\nrefine_camera = true\n", "'sfm.refine_camera' is gone.*finds its own"),
    ],
)
def test_wrong_settings_are_refused_by_name(tmp_path, text, words):
    path = tmp_path / "mapping.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=words):
        load_settings(path)
