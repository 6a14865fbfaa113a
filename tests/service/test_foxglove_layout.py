"""The layout for Foxglove's app shows what the station says, by the names under which it does."""

from __future__ import annotations

import json
import re
from typing import Any

import pytest
from station_notes import PAYLOAD
from test_foxglove_server import SCHEMAS

from ground_station.service.foxglove import documents, layout
from pi_firmware.wire.errors import BlimpError

OF_JSON = {"estimate": documents.ESTIMATE, "battery": documents.BATTERY}


def test_every_topic_in_it_is_one_of_the_stations_and_every_path_one_of_its_fields() -> None:
    text = layout.layout(PAYLOAD).to_json()
    named = re.findall(r'"(/[^"]+)"', text)
    assert len(named) >= 9
    for name in named:
        topic, *fields = name.split(".")
        assert topic in SCHEMAS, name
        schema: Any = OF_JSON[topic.rpartition("/")[2]] if fields else {}
        for field in fields:
            schema = schema["properties"][field]
    assert json.loads(text)["content"]


@pytest.mark.parametrize("name", ["", "A/B", "../x"])
def test_a_name_that_is_none_is_refused(name: str) -> None:
    with pytest.raises(BlimpError):
        layout.layout(name)
