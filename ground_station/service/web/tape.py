"""A recording of the ground's as the messages that it was made of, from any time on."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from ground_station.errors import InputError
from ground_station.service import bus_messages
from ground_station.service.bus_messages import (
    EstimateMessage,
    EventMessage,
    Message,
    PayloadMessage,
)
from ground_station.service.intake.files import ESTIMATE_STATE_TOPIC, MAP_TABLE, STATION_TOPIC
from pi_firmware.wire.errors import BlimpError
from pi_firmware.wire.recording import VIDEO_TOPIC, Readable, RecordingReader

_MARKS = 500
_NOTES: dict[str, type[Message]] = {
    bus_messages.EVENT: EventMessage,
    bus_messages.PAYLOAD: PayloadMessage,
}


@dataclass(frozen=True)
class TimedMessage:
    """A message of the bus, or an access unit of video (Annex B), at a log time."""

    log_ns: int
    payload_id: str
    kind: str
    note: Message | None = None
    video: bytes = b""


class Tape:
    """What lies in a recording, and when; raises a `BlimpError` for what cannot be played.

    `begin_ns` and `end_ns` are this machine's clock. `marks` are the alarms and warnings that the
    station raised then. A recording without an index, as after a cut, is read through once. Poses
    are told as `named` names their map.
    """

    def __init__(
        self,
        path: Readable,
        named: Callable[[EstimateMessage], EstimateMessage] = lambda note: note,
    ) -> None:
        self._named = named
        self._reader = reader = RecordingReader(path)
        summary = reader.summary
        figures = summary.statistics if summary else None
        self.map = ""
        if summary is not None and figures is not None and figures.message_count:
            topics = {channel.topic for channel in summary.channels.values()}
            self.begin_ns, self.end_ns = figures.message_start_time, figures.message_end_time
            maps = {index.name for index in summary.metadata_indexes}
        else:
            topics, begin_ns, end_ns = set(), 1 << 63, 0
            for channel, message in reader.messages():
                topics.add(channel.topic)
                begin_ns, end_ns = min(begin_ns, message.log_time), max(end_ns, message.log_time)
            if not topics:
                raise InputError(f"{path.name}: nothing in it can be read")
            self.begin_ns, self.end_ns = begin_ns, end_ns
            maps = set(reader.metadata)
        names = sorted(name.removeprefix(MAP_TABLE) for name in maps if name.startswith(MAP_TABLE))
        self.map = names[0] if names else ""
        self._sources = dict(_sources(topics))
        if not self._sources:
            raise InputError(f"{path.name}: neither video nor what a station says of its payloads")
        self.told = any(kind == bus_messages.PAYLOAD for _, kind in self._sources.values())
        """Whether it says how its payloads are, as a station's recordings do."""
        self.payloads = sorted(
            {name for name, _ in self._sources.values() if name != bus_messages.STATION}
        )
        self.marks = list(self._marks())

    def since(self, from_ns: int) -> Iterator[TimedMessage]:
        """What was heard from a time on, in order."""
        return self._heard(from_ns, set(self._sources))

    def _heard(self, from_ns: int, topics: set[str]) -> Iterator[TimedMessage]:
        for channel, message in self._reader.since(from_ns, topics):
            payload_id, kind = self._sources[channel.topic]
            if kind == VIDEO_TOPIC:
                with contextlib.suppress(ValueError):  # what is no video is left out
                    yield TimedMessage(
                        message.log_time, payload_id, kind, video=_unit(message.data)
                    )
                continue
            with contextlib.suppress(BlimpError):  # as is what an older station said otherwise
                note = bus_messages.decode(_NOTES.get(kind, EstimateMessage), message.data)
                note = self._named(note) if isinstance(note, EstimateMessage) else note
                yield TimedMessage(message.log_time, payload_id, kind, note)

    def _marks(self) -> Iterator[dict[str, Any]]:
        events = {topic for topic, (_, kind) in self._sources.items() if kind == bus_messages.EVENT}
        count = 0
        for heard in self._heard(self.begin_ns, events) if events else ():
            note = heard.note
            if not isinstance(note, EventMessage) or note.level == bus_messages.INFO:
                continue
            if (count := count + 1) > _MARKS:
                return
            yield {
                "at_s": round(1e-9 * (heard.log_ns - self.begin_ns), 3),
                "level": note.level,
                "payload": heard.payload_id,
                "text": note.text.removeprefix("alarm begins: ")[:200],
            }


def _unit(data: bytes) -> bytes:
    from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
    from google.protobuf.message import DecodeError

    try:
        message = CompressedVideo.FromString(data)
    except DecodeError:
        raise ValueError("no video") from None
    if message.format != "h264":
        raise ValueError("another format")
    return bytes(message.data)


def _sources(topics: Iterable[str]) -> Iterator[tuple[str, tuple[str, str]]]:
    """Of each topic that is played its payload and kind, as `GroundRun` has written them."""
    topics = sorted(topics)
    said = [topic.split("/") for topic in topics if topic.startswith(f"{STATION_TOPIC}/")]
    named = {parts[2] for parts in said if len(parts) == 4}
    prefixes = {topic.removesuffix(VIDEO_TOPIC) for topic in topics if topic.endswith(VIDEO_TOPIC)}
    # The first payload's topics are without its name.
    first = min(named - {prefix[1:] for prefix in prefixes}, default="recording")
    of: Callable[[str], str] = lambda prefix: prefix[1:] or first  # noqa: E731
    for topic in topics:
        for ending, kind in (
            (VIDEO_TOPIC, VIDEO_TOPIC),
            (ESTIMATE_STATE_TOPIC, bus_messages.ESTIMATE),
        ):
            if topic.endswith(ending) and "/" not in (name := topic.removesuffix(ending))[1:]:
                yield topic, (of(name), kind)
    for parts in said:
        if parts[-1] in _NOTES and len(parts) in (3, 4):
            payload_id = parts[2] if len(parts) == 4 else bus_messages.STATION
            yield "/".join(parts), (payload_id, parts[-1])
