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
    if state["recording"] is not None:
        limit_MB = state["station"]["min_free_MB"]
        yield from _of_recording(state["recording"], limit_MB, standing)
    yield from _of_processes(state)
    yield from _of_maps(state, now_ns)
    yield from _of_unlisted(state, now_ns)
    if state["fleet"] is not None:
        yield from _of_stations(state["fleet"])
    yield from _of_neighbours(state, standing)
    for payload_id, view in state["payloads"].items():
        if not view["alive"]:
            yield from _of_gone(payload_id, view)
        elif not view["payload"]["relayed"]:  # else its own station judges it, and says it
            yield from _of_flight(payload_id, view)
            yield from _of_link(payload_id, view, standing)
            yield from _of_board(payload_id, view["payload"], standing)


def _of_flight(payload_id: str, view: Mapping[str, Any]) -> Iterator[Alarm]:
    alive_s, frame_s, estimate_s = (
        view["alive_s"], view["age_s"]["frame"], view["age_s"]["estimate"]
    )  # fmt: skip
    frames_come = frame_s is not None and frame_s <= NO_FRAMES_S
    if not frames_come and (other := view["payload"]["station"]):
        text = f"flies with station '{other}', which gets its video"
        yield Alarm(f"elsewhere/{payload_id}", INFO, payload_id, text)
    elif not frames_come and alive_s > NO_FRAMES_S:  # one that came just now gets a moment
        since_s = alive_s if frame_s is None else min(frame_s, alive_s)
        text = f"no frames for {since_s:.0f} s"
        if frame_s is None:  # telemetry comes through, and never any video
            text += ": a firewall? sudo blimp doctor looks"
        yield Alarm(f"no-frames/{payload_id}", ALARM, payload_id, text)
    if estimate_s is None:
        return
    if estimate_s <= NO_FRAMES_S:
        yield from _of_estimate(payload_id, view)
    if frames_come and min(estimate_s, alive_s) > NO_POSES_S:
        text = f"frames come, but none was localized for {estimate_s:.0f} s"
        yield Alarm(f"no-poses/{payload_id}", ALARM, payload_id, text)


def _of_estimate(payload_id: str, view: Mapping[str, Any]) -> Iterator[Alarm]:
    estimate, state_s, nothing_s = view["estimate"], view["state_s"], view["nothing_known_s"] or 0.0
    reason = estimate["reason"]
    if nothing_s > NOTHING_KNOWN_S and not reason.startswith(NO_MAP):
        text = f"nothing of the map {estimate['map']} has been recognised for {nothing_s:.0f} s"
        yield Alarm(f"lost/{payload_id}", ALARM, payload_id, f"{text}: is it this building?")
    elif estimate["state"] == "LOST" and state_s > LOST_S:
        text = f"LOST for {state_s:.0f} s" + (f": {reason}" if reason else "")
        yield Alarm(f"lost/{payload_id}", ALARM, payload_id, text)
    if overload := estimate["overload"]:
        yield Alarm(f"overload/{payload_id}", WARNING, payload_id, overload)


def _of_link(payload_id: str, view: Mapping[str, Any], standing: frozenset[str]) -> Iterator[Alarm]:
    note, name = view["payload"], f"radio/{payload_id}"
    share = note["lost_share"]
    if share > (LOSS_NO_MORE_HIGH if name in standing else LOSS_HIGH):
        signal = (note["health"] or {}).get("wifi_signal_dBm")
        text = f"the radio loses {100 * share:.0f} % of the packets"
        text += f", at {signal:.0f} dBm" if signal is not None else ""
        yield Alarm(name, WARNING, payload_id, f"{text}: nearer to the access point?")
    name, unknown_s = f"clock/{payload_id}", view["clock_unknown_s"]
    uncertain_s = 1e-9 * note["clock"]["uncertainty_ns"] if note["clock"] else 0.0
    if uncertain_s > CLOCK_LOOSE_S * (CLOCK_OVER if name in standing else 1.0):
        text = f"the payload's clock is known to ±{1e3 * uncertain_s:.0f} ms only: slow network?"
        yield Alarm(name, WARNING, payload_id, text)
    if unknown_s is not None and unknown_s > CLOCK_UNKNOWN_S:
        text = "the payload's clock is not known: poses have no exact time"
        yield Alarm(name, WARNING, payload_id, text)


def _of_board(
    payload_id: str, note: Mapping[str, Any], standing: frozenset[str]
) -> Iterator[Alarm]:
    battery, health = note["battery"] or {}, note["health"] or {}
    level = {ALARM_CRITICAL: ALARM, ALARM_LOW: WARNING}.get(battery.get("alarm", ""))
    if level is not None:
        text = "battery critical" if level == ALARM else "battery low"
        figures = (("voltage", 1, ".2f", "V"), ("percentage", 100, ".0f", "%"),
                   ("time_left_s", 1 / 60, ".0f", "min left"))  # fmt: skip
        parts = [
            f"{battery[key] * scale:{form}} {unit}"
            for key, scale, form, unit in figures
            if battery.get(key) is not None
        ]
        text += f": {', '.join(parts)}" if parts else ""
        yield Alarm(f"battery/{payload_id}", level, payload_id, text)
    name, celsius = f"hot/{payload_id}", health.get("temperature_C")
    if celsius is not None and celsius > (NO_MORE_HOT_C if name in standing else HOT_C):
        text = f"the payload's processor has {celsius:.0f} °C"
        yield Alarm(name, WARNING, payload_id, text)
    held = [one for one in health.get("throttled") or () if not one.endswith(WAS)]
    if held:
        text = f"the payload's board is held back: {', '.join(held)}"
        text += ": is its cell or its wiring too weak?" if UNDERVOLTAGE in held else ""
        yield Alarm(f"throttled/{payload_id}", WARNING, payload_id, text)
    name, free_MB = f"payload-disk/{payload_id}", health.get("disk_free_MB")
    if health.get("recording") and _below(free_MB, DISK_WARNING_MB, name in standing):
        text = f"{free_MB:.0f} MB left on the payload's card, which records"
        yield Alarm(name, WARNING, payload_id, text)


def _of_gone(payload_id: str, view: Mapping[str, Any]) -> Iterator[Alarm]:
    gone_s = view["gone_s"]
    if gone_s is None or gone_s > GONE_FOR_S:  # never here, or switched off for long
        return
    name = f"gone/{payload_id}"
    if view["ended"]:
        yield Alarm(name, INFO, payload_id, "ended in order")
    else:
        yield Alarm(name, ALARM, payload_id, "gone: nothing is heard of the payload")


def _of_recording(
    recording: Mapping[str, Any], limit_MB: float, standing: frozenset[str]
) -> Iterator[Alarm]:
    if recording["problem"]:
        yield Alarm("recording", ALARM, STATION, f"recording: {recording['problem']}")
    if recording["resumed"] and recording["duration_s"] < RESUMED_S:
        yield Alarm("resumed", WARNING, STATION, f"recording: {recording['resumed']}")
    free_MB = recording["free_MB"]
    # It ends at the setting's limit: the warning comes before.
    limit_MB += max(limit_MB, DISK_WARNING_MB)
    if recording["active"] and _below(free_MB, limit_MB, "disk" in standing):
        yield Alarm("disk", WARNING, STATION, f"{free_MB:.0f} MB left on the recordings' disk")


def _of_processes(state: Mapping[str, Any]) -> Iterator[Alarm]:
    payloads = state["payloads"]
    for process in state["processes"]:
        name, age_s, restarted_s = process["name"], process["age_s"], process["restarted_s"]
        kind, _, payload_id = name.partition("/")
        payload = payload_id if payload_id in payloads else STATION
        if payload_id and not (payload_id in payloads and payloads[payload_id]["alive"]):
            continue  # a localizer ends with its payload
        if age_s > SILENT_S:
            level = ALARM if kind in ("intake", "localizer") else WARNING
            text = f"the process {name} is silent for {age_s:.0f} s"
            yield Alarm(f"silent/{name}", level, payload, text)
        if restarted_s is not None and restarted_s < RESTARTED_S:
            yield Alarm(f"restarted/{name}", WARNING, payload, f"the process {name} was restarted")


def _of_maps(state: Mapping[str, Any], now_ns: int) -> Iterator[Alarm]:
    refused: dict[str, Alarm] = {}
    for event in state["events"]:
        if event["name"] == MAP_REFUSED and abs(now_ns - event["time_ns"]) < MAP_REFUSED_S * 1e9:
            payload_id = event["payload"]
            level = ALARM if event["level"] == ALARM else WARNING
            refused[payload_id] = Alarm(f"map/{payload_id}", level, payload_id, event["text"])
    for payload_id, view in state["payloads"].items():
        # A localizer without a map says so with its frames.
        reason = view["estimate"]["reason"] if view["estimate"] else ""
        if reason.startswith(NO_MAP) and view["alive"]:
            refused[payload_id] = Alarm(f"map/{payload_id}", ALARM, payload_id, reason)
    yield from refused.values()


def _of_unlisted(state: Mapping[str, Any], now_ns: int) -> Iterator[Alarm]:
    # An intake that is started again says it again, where that is still so.
    restarts_s = [one["restarted_s"] for one in state["processes"] if one["name"] == "intake"]
    since_ns = max((now_ns - 1e9 * at_s for at_s in restarts_s if at_s is not None), default=0.0)
    said = [
        event
        for event in state["events"]
        if event["name"] == UNLISTED and event["time_ns"] >= since_ns
    ]
    newest = max(said, key=lambda event: int(event["time_ns"]), default=None)
    if newest is not None and newest["level"] == WARNING:
        yield Alarm(UNLISTED, WARNING, STATION, newest["text"])


def _of_neighbours(state: Mapping[str, Any], standing: frozenset[str]) -> Iterator[Alarm]:
    """Two blimps too near each other, whichever stations they fly with, in maps of one origin."""
    limit_m = state["station"]["apart_m"]
    where: dict[str, tuple[str, list[float]]] = {}
    for payload_id, view in state["payloads"].items():
        estimate, age_s = view["estimate"], view["age_s"]["estimate"]
        if estimate is None or age_s > NO_FRAMES_S or estimate["position_m"] is None:
            continue
        if estimate["state"] in ("TRACKING", "DEGRADED"):
            at = estimate["coordinates"] or estimate["map"]
            where[payload_id] = at, estimate["position_m"]
    for one, other in itertools.combinations(sorted(where), 2):
        (ours, here), (theirs, there) = where[one], where[other]
        name, distance_m = f"near/{one}/{other}", math.dist(here, there)
        if ours == theirs and distance_m < limit_m * (NEAR_OVER if name in standing else 1.0):
            yield Alarm(name, ALARM, one, f"{distance_m:.1f} m from {other}")


def _of_stations(fleet: Mapping[str, Any]) -> Iterator[Alarm]:
    for other in fleet["stations"]:
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
    for offer in fleet["offers"]:
        station, name = offer["station"], offer["map"]
        text = f"station '{station}' has '{name}', this map with {offer['more']} landmarks more"
        yield Alarm(f"station-offers/{station}/{name}", INFO, STATION, f"{text}: Map… (M)")
    for payload_id, name in fleet["twins"].items():
        text = f"two payloads have this name: one flies here, one with station '{name}'"
        yield Alarm(f"twin/{payload_id}", ALARM, payload_id, text)
    for text in fleet["refused"]:
        yield Alarm(f"refused/{text[:80]}", WARNING, STATION, f"not joined: {text}")


def _below(value: float | None, limit: float, stands: bool) -> bool:
    return value is not None and value < limit * (DISK_OVER if stands else 1.0)
