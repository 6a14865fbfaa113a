"""Notes that cannot be said on again are none: they would end whoever shows them."""

from __future__ import annotations

import json

import pytest

from ground_station.service import bus_messages
from ground_station.service.bus_messages import MessageError, PayloadMessage


def payload(battery: str) -> bytes:
    return f'{{"alive": true, "seen_ns": 1, "battery": {{"a": {battery}}}}}'.encode()


@pytest.mark.parametrize("depth", [40, 300, 900])
@pytest.mark.parametrize(("begin", "end"), [("[", "]"), ('{"a":', "}"), ("[1,", "]")])
def test_a_note_that_nests_without_end_is_refused(depth: int, begin: str, end: str) -> None:
    with pytest.raises(MessageError, match=r"PayloadMessage: it nests deeper than 32"):
        bus_messages.decode(PayloadMessage, payload(begin * depth + "1" + end * depth))


def test_a_note_of_many_lists_and_few_levels_is_taken() -> None:
    text = payload(json.dumps([[1, {"b": [2]}]] * 100))
    note = bus_messages.decode(PayloadMessage, text)
    assert bus_messages.decode(PayloadMessage, bus_messages.encode(note)) == note
    assert bus_messages.as_document(note)["battery"] == {"a": [[1, {"b": [2]}]] * 100}


def test_a_refusal_is_one_line_whatever_the_note_holds() -> None:
    with pytest.raises(bus_messages.MessageError) as refused:
        bus_messages.decode(bus_messages.ProcessMessage, b'{"\\u000c\\n\\u0000": 1}')
    assert str(refused.value).isprintable()
