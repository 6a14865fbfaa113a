"""`pi_firmware.wire.recording`: MCAP files whole, cut, flipped, or made to hurt."""

from __future__ import annotations

from pieces import refusing, scratch

from pi_firmware.wire import mcap_records, recording
from pi_firmware.wire.errors import RecordingError
from readers import mcap_file

_FILE = scratch("recording") / "flight.mcap"
# A claim that asks for more memory than there is must be refused before it asks.
mcap_records.PARSE_ERRORS = tuple(
    kind for kind in mcap_records.PARSE_ERRORS if kind is not MemoryError
)
recording.PARSE_ERRORS = mcap_records.PARSE_ERRORS


def fuzz(data: bytes) -> None:
    """Every way to read it ends, by the same messages or by one line."""
    _FILE.write_bytes(mcap_file.build(data))
    with refusing(RecordingError):
        reader = recording.RecordingReader(_FILE)
        counts = reader.topics()
        assert bool(reader.cut_reason) == reader.cut
        assert sum(counts.values()) == sum(1 for _ in reader.messages())
        reader.message_count(recording.VIDEO_TOPIC)
        reader.metadata_table("camera")
        for read in (
            lambda: list(reader.video()),
            reader.calibration,
            lambda: reader.poses(recording.TRUTH_TOPIC),
            lambda: list(reader.json(recording.FRAME_INFO_TOPIC)),
        ):
            with refusing(RecordingError):
                read()


def seeds() -> list[bytes]:
    """Small flights."""
    return mcap_file.seeds()
