"""A recording as the station writes one, and the station's pages with it on the shelf."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import web_station as station

from ground_station.service import bus_messages
from ground_station.service.web.app import build
from pi_firmware.wire.recording import RecordingReader, RecordingWriter

T0_NS, RATE_HZ, SECONDS = 1_700_000_000_000_000_000, 30.0, 14.0
P, OTHER = station.PAYLOAD, "blimp-2"
FLIGHT = station.ATRIUM / "flight.mcap"
ALARM, ALARM_S = "alarm begins: LOST for 2 s: searching", 6.0


def x_of(at_s: float) -> float:
    """Where the payload was then, metres: it flies along x."""
    return round(0.5 * at_s, 3)


def write(path: Path, *, told: bool = True) -> Path:
    """As `GroundRun` writes: a flight along x, a second payload, an alarm at 6 s; or video."""
    units = [sample.data for sample in RecordingReader(FLIGHT).video()][: int(SECONDS * RATE_HZ)]
    with RecordingWriter(path) as writer:
        if told:
            writer.write_metadata("map atrium", {"name": "atrium"})

        def say(topic: str, at_ns: int, note: bus_messages.Message) -> None:
            writer.write_json_text(topic, at_ns, bus_messages.encode(note), schema_name="x")

        for k, unit in enumerate(units):
            at_s = k / RATE_HZ
            at_ns = T0_NS + int(1e9 * at_s)
            writer.write_video(at_ns - 5, unit, log_ns=at_ns)
            if not told:
                continue
            note = station.estimate(
                k, capture_ns=at_ns, done_ns=at_ns, points_px=[], position_m=[x_of(at_s), 2.0, 1.5],
                state="LOST" if ALARM_S <= at_s < ALARM_S + 3 else "TRACKING",
            )  # fmt: skip
            say("/estimate/state", at_ns, note)
            if k % 15 == 0:
                for name in (P, OTHER):
                    battery = {"voltage": round(4.2 - 0.01 * at_s, 3)}
                    say(f"/station/{name}/payload", at_ns, station.payload(battery=battery))
            if k == int(ALARM_S * RATE_HZ):
                said = station.event(level="alarm", name="alarm-begins", text=ALARM, time_ns=at_ns)
                say(f"/station/{P}/event", at_ns, said)
                say("/station/event", at_ns, station.event(text="of no weight", time_ns=at_ns))
    return path


@contextlib.contextmanager
def serving(folder: Path, flight: Path) -> Iterator[int]:
    """The application behind the real server, with the flight among its recordings; its port."""
    bus = station.SilentBus()
    web = build(station.run_of(folder, video_rate_hz=20.0), folder, bus, None)
    (folder / "recordings" / "flight.mcap").write_bytes(flight.read_bytes())
    with station.serving(web) as port:
        yield port
