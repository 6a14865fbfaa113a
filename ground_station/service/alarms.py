"""What an operator must not miss: a pure function of the station's state and the alarms before it.

A cause that comes and goes does not make its alarm flicker: an alarm stands for `HOLD_S` after its
cause was last found, its level falls no sooner, and where a number has a limit the one that ends
the alarm lies apart from the one that begins it.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from ground_station.service.bus_messages import ALARM, INFO, STATION, WARNING, Level
from pi_firmware.wire.messages import ALARM_CRITICAL, ALARM_LOW, UNDERVOLTAGE, WAS

HOLD_S = 3.0
LOST_S, NO_FRAMES_S, NO_POSES_S, CLOCK_UNKNOWN_S = 2.0, 2.0, 4.0, 10.0
NOTHING_KNOWN_S = 10.0
CLOCK_LOOSE_S, CLOCK_OVER = 0.05, 0.8
LOSS_HIGH, LOSS_NO_MORE_HIGH = 0.05, 0.03
"""Of the packets; what is sent again fixes nearly all of less."""
SILENT_S, RESTARTED_S = 5.0, 30.0
RESUMED_S = 120.0
GONE_FOR_S = 600.0
CLOCKS_APART_S = 1.0
EVERYWHERE = ("near/", "station/", "station-clock/", "station-map/")
"""How the alarms begin that each of several stations finds by itself."""
NEAR_OVER = 1.2
DISK_WARNING_MB, DISK_OVER = 500.0, 1.2
HOT_C, NO_MORE_HOT_C = 80.0, 76.0

MAP_REFUSED, NO_MAP = "map-refused", "no map:"
"""A localizer's event, and how its reason begins, where a map does not fit its features, say."""
MAP_REFUSED_S = 20.0
UNLISTED = "unlisted"
"""The intake's event where somebody's certificate is not on the list, and where that is over."""

_RANK = {INFO: 0, WARNING: 1, ALARM: 2}


@dataclass(frozen=True)
class Alarm:
    """One alarm; `id` is the same as long as it stands, `payload` is "-" where it is of none."""

    id: str
    level: Level
    payload: str
    text: str
    since_ns: int = 0


@dataclass(frozen=True)
class Standing:
    """An alarm with the time at which its cause was last found at this level."""

    alarm: Alarm
    found_ns: int


Alarms = Mapping[str, Standing]


def judge(state: Mapping[str, Any], now_ns: int, before: Alarms) -> dict[str, Standing]:
    """The alarms that stand now, by id.

    `state` is the document of GET /api/state, `now_ns` the wall clock, `before` what this function
    returned last. A clock that is set back makes no alarm stand longer than `HOLD_S` from then on.
    """
    result: dict[str, Standing] = {}
    for alarm in _found(state, now_ns, frozenset(before)):
        old, since_ns = before.get(alarm.id), now_ns
        if old is not None:
            since_ns = min(old.alarm.since_ns, now_ns)
            if _RANK[alarm.level] < _RANK[old.alarm.level] and _held(old, now_ns):
                result[alarm.id] = _kept(old, now_ns)
                continue
        result[alarm.id] = Standing(dataclasses.replace(alarm, since_ns=since_ns), now_ns)
    for name, old in before.items():
        if name not in result and _held(old, now_ns):
            result[name] = _kept(old, now_ns)
    return result


def _held(old: Standing, now_ns: int) -> bool:
    return now_ns - old.found_ns <= HOLD_S * 1e9


def _kept(old: Standing, now_ns: int) -> Standing:
    return dataclasses.replace(old, found_ns=min(old.found_ns, now_ns))


def documents(alarms: Alarms) -> list[dict[str, Any]]:
    """The alarms as plain values, gravest first, then oldest."""
    ordered = sorted(
        (item.alarm for item in alarms.values()),
        key=lambda alarm: (-_RANK[alarm.level], alarm.since_ns, alarm.id),
    )
    return [dataclasses.asdict(alarm) for alarm in ordered]


def _found(state: Mapping[str, Any], now_ns: int, standing: frozenset[str]) -> Iterator[Alarm]:
    yield from _of_recording(state, standing)
    yield from _of_processes(state)
    yield from _of_maps(state, now_ns)
    yield from _of_unlisted(state, now_ns)
    yield from _of_stations(_table(state, "fleet"))
    yield from _of_neighbours(state, standing)
    for payload_id, view in _table(state, "payloads").items():
        if not isinstance(view, dict):
            continue
        if _table(view, "payload").get("relayed") and view.get("alive"):
            continue  # its own station does, and says it
        if not view.get("alive"):
            yield from _of_gone(payload_id, view)
            continue
        yield from _of_flight(payload_id, view)
        yield from _of_link(payload_id, view, standing)
        yield from _of_board(payload_id, view, standing)


def _of_flight(payload_id: str, view: Mapping[str, Any]) -> Iterator[Alarm]:
    alive_s = _number(view.get("alive_s")) or 0.0
    age_s = _table(view, "age_s")
    frame_s, estimate_s = _number(age_s.get("frame")), _number(age_s.get("estimate"))
    frames_come = frame_s is not None and frame_s <= NO_FRAMES_S
    if not frames_come and (other := _table(view, "payload").get("station")):
        text = f"flies with station '{other}', which gets its video"
        yield Alarm(f"elsewhere/{payload_id}", INFO, payload_id, text)
    elif not frames_come and alive_s > NO_FRAMES_S:  # one that came just now gets a moment
        since_s = alive_s if frame_s is None else min(frame_s, alive_s)
        text = f"no frames for {since_s:.0f} s"
        if frame_s is None:  # telemetry comes through, and never any video
            text += ": a firewall? sudo blimp doctor looks"
        yield Alarm(f"no-frames/{payload_id}", ALARM, payload_id, text)
    estimates_come = estimate_s is not None and estimate_s <= NO_FRAMES_S
    estimate, state_s = _table(view, "estimate"), _number(view.get("state_s")) or 0.0
    nothing_s = _number(view.get("nothing_known_s")) or 0.0
    reason = str(estimate.get("reason") or "")
    if estimates_come and nothing_s > NOTHING_KNOWN_S and not reason.startswith(NO_MAP):
        text = f"nothing of the map {estimate.get('map')} has been recognised for {nothing_s:.0f} s"
        yield Alarm(f"lost/{payload_id}", ALARM, payload_id, f"{text}: is it this building?")
    elif estimates_come and estimate.get("state") == "LOST" and state_s > LOST_S:
        text = f"LOST for {state_s:.0f} s" + (f": {reason}" if reason else "")
        yield Alarm(f"lost/{payload_id}", ALARM, payload_id, text)
    if estimates_come and (overload := str(estimate.get("overload") or "")):
        yield Alarm(f"overload/{payload_id}", WARNING, payload_id, overload)
    if frames_come and estimate_s is not None and min(estimate_s, alive_s) > NO_POSES_S:
        text = f"frames come, but none was localized for {estimate_s:.0f} s"
        yield Alarm(f"no-poses/{payload_id}", ALARM, payload_id, text)


def _of_link(payload_id: str, view: Mapping[str, Any], standing: frozenset[str]) -> Iterator[Alarm]:
    note = _table(view, "payload")
    share, name = _number(note.get("lost_share")), f"radio/{payload_id}"
    if share is not None and share > (LOSS_NO_MORE_HIGH if name in standing else LOSS_HIGH):
        signal = _number(_table(note, "health").get("wifi_signal_dBm"))
        text = f"the radio loses {100 * share:.0f} % of the packets"
        text += f", at {signal:.0f} dBm" if signal is not None else ""
        yield Alarm(name, WARNING, payload_id, f"{text}: nearer to the access point?")
    uncertain_ns = _number(_table(note, "clock").get("uncertainty_ns"))
    limit_s = CLOCK_LOOSE_S * (CLOCK_OVER if f"clock/{payload_id}" in standing else 1.0)
    if uncertain_ns is not None and uncertain_ns > 1e9 * limit_s:
        text = f"the payload's clock is known to ±{1e-6 * uncertain_ns:.0f} ms only: slow network?"
        yield Alarm(f"clock/{payload_id}", WARNING, payload_id, text)
    unknown_s = _number(view.get("clock_unknown_s"))
    if unknown_s is not None and unknown_s > CLOCK_UNKNOWN_S:
        text = "the payload's clock is not known: poses have no exact time"
        yield Alarm(f"clock/{payload_id}", WARNING, payload_id, text)


def _of_board(
    payload_id: str, view: Mapping[str, Any], standing: frozenset[str]
) -> Iterator[Alarm]:
    note = _table(view, "payload")
    battery, health = _table(note, "battery"), _table(note, "health")
    level = {ALARM_CRITICAL: ALARM, ALARM_LOW: WARNING}.get(str(battery.get("alarm")))
    if level is not None:
        text = "battery critical" if level == ALARM else "battery low"
        voltage, share = _number(battery.get("voltage")), _number(battery.get("percentage"))
        left_s = _number(battery.get("time_left_s"))
        parts = [
            *([f"{voltage:.2f} V"] if voltage is not None else []),
            *([f"{100 * share:.0f} %"] if share is not None else []),
            *([f"{left_s / 60:.0f} min left"] if left_s is not None else []),
        ]
        text += f": {', '.join(parts)}" if parts else ""
        yield Alarm(f"battery/{payload_id}", level, payload_id, text)
    name = f"hot/{payload_id}"
    celsius = _number(health.get("temperature_C"))
    if celsius is not None and celsius > (NO_MORE_HOT_C if name in standing else HOT_C):
        text = f"the payload's processor has {celsius:.0f} °C"
        yield Alarm(name, WARNING, payload_id, text)
    held = [str(one) for one in health.get("throttled") or () if not str(one).endswith(WAS)]
    if held:
        text = f"the payload's board is held back: {', '.join(held)}"
        text += ": is its cell or its wiring too weak?" if UNDERVOLTAGE in held else ""
        yield Alarm(f"throttled/{payload_id}", WARNING, payload_id, text)
    name = f"payload-disk/{payload_id}"
    free_MB = _number(health.get("disk_free_MB"))
    if health.get("recording") and _below(free_MB, DISK_WARNING_MB, name in standing):
        text = f"{free_MB:.0f} MB left on the payload's card, which records"
        yield Alarm(name, WARNING, payload_id, text)


def _of_gone(payload_id: str, view: Mapping[str, Any]) -> Iterator[Alarm]:
    gone_s = _number(view.get("gone_s"))
    if gone_s is None or gone_s > GONE_FOR_S:  # never here, or switched off for long
        return
    name = f"gone/{payload_id}"
    if view.get("ended"):
        yield Alarm(name, INFO, payload_id, "ended in order")
    else:
        yield Alarm(name, ALARM, payload_id, "gone: nothing is heard of the payload")


def _of_recording(state: Mapping[str, Any], standing: frozenset[str]) -> Iterator[Alarm]:
    recording = _table(state, "recording")
    if recording.get("problem"):
        yield Alarm("recording", ALARM, STATION, f"recording: {recording['problem']}")
    resumed, lasts_s = recording.get("resumed"), _number(recording.get("duration_s")) or 0.0
    if resumed and lasts_s < RESUMED_S:
        yield Alarm("resumed", WARNING, STATION, f"recording: {resumed}")
    free_MB = _number(recording.get("free_MB"))
    # It ends at the setting's limit: the warning comes before.
    limit_MB = _number(_table(state, "station").get("min_free_MB")) or 0.0
    limit_MB = limit_MB + max(limit_MB, DISK_WARNING_MB)
    if recording.get("active") and _below(free_MB, limit_MB, "disk" in standing):
        yield Alarm("disk", WARNING, STATION, f"{free_MB:.0f} MB left on the recordings' disk")


def _of_processes(state: Mapping[str, Any]) -> Iterator[Alarm]:
    payloads = _table(state, "payloads")
    for process in state.get("processes") or ():
        name, age_s = str(process.get("name")), _number(process.get("age_s"))
        kind, _, payload_id = name.partition("/")
        payload = payload_id if payload_id in payloads else STATION
        # A localizer ends with its payload.
        wanted = not payload_id or bool(_table(payloads, payload_id).get("alive"))
        if wanted and age_s is not None and age_s > SILENT_S:
            level = ALARM if kind in ("intake", "localizer") else WARNING
            text = f"the process {name} is silent for {age_s:.0f} s"
            yield Alarm(f"silent/{name}", level, payload, text)
        restarted_s = _number(process.get("restarted_s"))
        if wanted and restarted_s is not None and restarted_s < RESTARTED_S:
            yield Alarm(f"restarted/{name}", WARNING, payload, f"the process {name} was restarted")


def _of_maps(state: Mapping[str, Any], now_ns: int) -> Iterator[Alarm]:
    refused: dict[str, Alarm] = {}
    for event in state.get("events") or ():
        time_ns = _number(event.get("time_ns"))
        if event.get("name") != MAP_REFUSED or time_ns is None:
            continue
        if abs(now_ns - time_ns) < MAP_REFUSED_S * 1e9:
            payload_id, text = str(event.get("payload")), str(event.get("text"))
            level = ALARM if event.get("level") == ALARM else WARNING
            refused[payload_id] = Alarm(f"map/{payload_id}", level, payload_id, text)
    for payload_id, view in _table(state, "payloads").items():
        # A localizer without a map says so with its frames.
        reason = str(_table(view, "estimate").get("reason") or "")
        if reason.startswith(NO_MAP) and isinstance(view, dict) and view.get("alive"):
            refused[payload_id] = Alarm(f"map/{payload_id}", ALARM, payload_id, reason)
    yield from refused.values()


def _of_unlisted(state: Mapping[str, Any], now_ns: int) -> Iterator[Alarm]:
    # An intake that is started again says it again, where that is still so.
    of_intake: Iterator[Mapping[str, Any]] = (
        one for one in state.get("processes") or () if one.get("name") == "intake"
    )
    restarted_s = _number(next(of_intake, {}).get("restarted_s"))
    since_ns = now_ns - 1e9 * (math.inf if restarted_s is None else restarted_s)
    said = [
        event
        for event in state.get("events") or ()
        if event.get("name") == UNLISTED and (_number(event.get("time_ns")) or 0.0) >= since_ns
    ]
    newest = max(said, key=lambda event: _number(event.get("time_ns")) or 0.0, default=None)
    if newest is not None and newest.get("level") == WARNING:
        yield Alarm(UNLISTED, WARNING, STATION, str(newest.get("text")))


def _of_neighbours(state: Mapping[str, Any], standing: frozenset[str]) -> Iterator[Alarm]:
    """Two blimps too near each other, whichever stations they fly with, in maps of one origin."""
    limit_m = _number(_table(state, "station").get("apart_m")) or 0.0
    where: dict[str, Any] = {}
    for payload_id, view in _table(state, "payloads").items():
        estimate, age_s = _table(view, "estimate"), _number(_table(view, "age_s").get("estimate"))
        position_m = [_number(value) for value in estimate.get("position_m") or ()]
        known = estimate.get("state") in ("TRACKING", "DEGRADED") and len(position_m) == 3
        if known and None not in position_m and age_s is not None and age_s <= NO_FRAMES_S:
            where[payload_id] = estimate.get("coordinates") or estimate.get("map"), position_m
    for one, other in itertools.combinations(sorted(where), 2):
        (ours, here), (theirs, there) = where[one], where[other]
        name, distance_m = f"near/{one}/{other}", math.dist(here, there)
        if ours == theirs and distance_m < limit_m * (NEAR_OVER if name in standing else 1.0):
            yield Alarm(name, ALARM, one, f"{distance_m:.1f} m from {other}")


def _of_stations(fleet: Mapping[str, Any]) -> Iterator[Alarm]:
    for other in fleet.get("stations") or ():
        name, age_s, clock_s = other["name"], other["age_s"], other["clock_s"]
        if age_s > SILENT_S:
            text = f"nothing is heard of station '{name}'"
            yield Alarm(f"station/{name}", WARNING, STATION, text)
            continue
        if abs(clock_s) > CLOCKS_APART_S:
            ahead = "ahead of" if clock_s > 0 else "behind"
            text = f"the clock of station '{name}' is {abs(clock_s):.1f} s {ahead} this one's"
            yield Alarm(f"station-clock/{name}", WARNING, STATION, f"{text}: timedatectl there?")
        if not other["same_map"] and other["payloads"]:
            text = (
                f"station '{name}' flies in another map, '{other['map']}': its poses are not shown"
            )
            yield Alarm(f"station-map/{name}", INFO, STATION, text)
    for offer in fleet.get("offers") or ():
        station, name = offer["station"], offer["map"]
        text = f"station '{station}' has '{name}', this map with {offer['more']} landmarks more"
        yield Alarm(f"station-offers/{station}/{name}", INFO, STATION, f"{text}: Map… (M)")
    for payload_id, name in _table(fleet, "twins").items():
        text = f"two payloads have this name: one flies here, one with station '{name}'"
        yield Alarm(f"twin/{payload_id}", ALARM, payload_id, text)
    for text in fleet.get("refused") or ():
        yield Alarm(f"refused/{text[:80]}", WARNING, STATION, f"not joined: {text}")


def _below(value: float | None, limit: float, stands: bool) -> bool:
    return value is not None and value < limit * (DISK_OVER if stands else 1.0)


def _table(of: Any, name: str) -> dict[str, Any]:
    value = of.get(name) if isinstance(of, Mapping) else None
    return value if isinstance(value, dict) else {}


def _number(value: Any) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value)
