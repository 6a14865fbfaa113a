// @ts-check
/** What the page knows, in one place. Views read it; messages change it and name what changed. */
import { Trail } from "./trail.js";

const OTHER_STALE_S = 3;
const EVENTS_KEPT = 500;
const POINTS_KEPT = 90;
const CLOCK_SET_BACK_NS = 5e9;
export const STALE_S = 2;

/** A payload as the page knows it; times that end in `_ms` are the page's monotonic clock. */
export class Payload {
  /** @param {string} id */
  constructor(id) {
    this.id = id;
    /** @type {import("./types.js").PayloadNote|null} */
    this.note = null;
    this.is_alive = false;
    this.told_ms = -Infinity;
    /** What is too old to be believed. @type {string[]} */
    this.stale = [];
    /** @type {Record<string, number|null>} */
    this.age_s = {};
    /** @type {import("./types.js").Estimate|null} */
    this.estimate = null;
    this.estimate_ms = -Infinity;
    this.state_ms = 0;
    /** The newest estimate with a position. @type {import("./types.js").Estimate|null} */
    this.placed = null;
    this.placed_ms = -Infinity;
    this.trail = new Trail();
    /** Landmarks of the newest frames by sequence number. @type {Map<number, number[]>} */
    this.points = new Map();
  }

  /** @param {import("./types.js").PayloadEntry} entry */
  takeEntry(entry) {
    const now_ms = performance.now();
    if (entry.payload) this.note = entry.payload;
    this.is_alive = entry.alive ?? Boolean(this.note?.alive);
    this.told_ms = now_ms;
    this.stale = entry.stale ?? [];
    this.age_s = entry.age_s ?? {};
    if (entry.trail) this.trail.replace(entry.trail, entry.trail_breaks ?? []);
    if (!entry.estimate) return;
    this.take(entry.estimate, now_ms - 1e3 * (entry.age_s?.estimate ?? 0));
    if (entry.state_s != null) this.state_ms = now_ms - 1e3 * entry.state_s;
  }

  /** @param {import("./types.js").Estimate} estimate @param {number} came_ms */
  take(estimate, came_ms) {
    const late_ns = (this.estimate?.done_ns ?? -Infinity) - estimate.done_ns;
    if (late_ns > 0 && late_ns < CLOCK_SET_BACK_NS) return; // an older one came by another way
    if (this.estimate?.state !== estimate.state) this.state_ms = came_ms;
    if (late_ns !== 0 || !this.estimate) this.estimate_ms = came_ms;
    if (estimate.points_px?.length || late_ns !== 0) this.estimate = estimate;
    if (estimate.points_px?.length) this.points.set(estimate.sequence, estimate.points_px);
    for (const sequence of this.points.keys()) {
      if (this.points.size <= POINTS_KEPT) break;
      this.points.delete(sequence);
    }
    if (!estimate.position_m) return;
    this.placed = this.estimate;
    this.placed_ms = this.estimate_ms;
    this.trail.add(estimate.position_m, estimate.state, estimate.done_ns);
  }
}

export class Store {
  /** @param {import("./clock.js").StationClock} clock @param {(topic: string) => void} changed */
  constructor(clock, changed) {
    this.clock = clock;
    this.changed = changed;
    /** @type {import("./types.js").Station} */
    this.station = {};
    /** @type {Map<string, Payload>} */
    this.payloads = new Map();
    this.selected = "";
    /** Newest first. @type {import("./types.js").Event[]} */
    this.events = [];
    /** @type {import("./types.js").Alarm[]} */
    this.alarms = [];
    /** @type {import("./types.js").RecordingNote|null} */
    this.recording = null;
    /** @type {import("./types.js").Job|null} */
    this.job = null;
    /** Where a recording is that is shown in place of the live flight. @type {{at_s: number, playing: boolean, rate: number}|null} */
    this.playback = null;
    /** The stations that this one flies beside. @type {import("./types.js").Fleet|null} */
    this.fleet = null;
    /** @type {any[]} */
    this.processes = [];
    /** @type {import("./connection.js").Status} */
    this.link = { phase: "connecting", since_ms: performance.now(), retry_ms: 0, reason: "" };
  }

  /** Forgets what was shown: another source is. */
  clear() {
    this.payloads.clear();
    this.select("");
    [this.events, this.alarms, this.recording, this.job, this.playback] = [[], [], null, null, null];
    for (const topic of ["payloads", "payload", "estimate", "trail", "events", "alarms", "recording", "job"]) this.changed(topic);
  }

  /** The names of the other stations that are there now. */
  otherStations() {
    return (this.fleet?.stations ?? []).filter((other) => other.age_s < OTHER_STALE_S).map((other) => other.name);
  }

  /** @returns {Payload|null} */
  get current() {
    return this.payloads.get(this.selected) ?? null;
  }

  /** @param {string} id */
  payload(id) {
    let payload = this.payloads.get(id);
    if (!payload) {
      payload = new Payload(id);
      this.payloads.set(id, payload);
      this.changed("payloads");
    }
    return payload;
  }

  /** @param {string} id */
  select(id) {
    if (id === this.selected) return;
    this.selected = id;
    for (const topic of ["selection", "payloads", "payload", "estimate", "trail"]) this.changed(topic);
  }

  /** Takes a whole snapshot or the parts that are there. @param {import("./types.js").Snapshot} snapshot */
  take(snapshot) {
    if (snapshot.station) {
      this.station = { ...this.station, ...snapshot.station };
      this.fleet = snapshot.fleet ?? null;
      this.changed("station");
    }
    for (const [id, entry] of Object.entries(snapshot.payloads ?? {})) {
      this.payload(id).takeEntry(entry);
    }
    if (snapshot.payloads) {
      this.forget(snapshot.payloads);
      for (const topic of ["payload", "estimate", "trail"]) this.changed(topic);
      if (!this.selected) this.select(this.firstId());
    }
    this.playback = snapshot.playback ?? null;
    if (snapshot.job !== undefined) {
      this.job = snapshot.job;
      this.changed("job");
    }
    if (snapshot.processes) this.processes = snapshot.processes;
    if (snapshot.events) this.takeEvents(snapshot.events);
    if (snapshot.alarms) this.takeAlarms(snapshot.alarms);
    if (snapshot.recording) this.takeRecording(snapshot.recording);
  }

  /** Those that the station does not know any more. @param {Record<string, unknown>} known */
  forget(known) {
    for (const id of [...this.payloads.keys()]) {
      if (id in known) continue;
      this.payloads.delete(id);
      if (id === this.selected) this.select(this.firstId());
      this.changed("payloads");
    }
  }

  /** The first that lives, or the first. */
  firstId() {
    const all = [...this.payloads.values()];
    return (all.find((payload) => payload.is_alive) ?? all[0])?.id ?? "";
  }

  /** @param {string} id @param {import("./types.js").Estimate} estimate */
  takeEstimate(id, estimate) {
    this.payload(id).take(estimate, performance.now());
    if (!this.selected) this.select(id);
    this.changed(id === this.selected ? "estimate" : "others");
  }

  /** Snapshots and live events overlap; each is kept once. @param {import("./types.js").Event[]} events */
  takeEvents(events) {
    const key = (/** @type {import("./types.js").Event} */ e) => `${e.time_ns}|${e.source}|${e.name}|${e.text}`;
    const known = new Set(this.events.map(key));
    const fresh = events.filter((event) => !known.has(key(event)));
    if (!fresh.length) return;
    this.events = [...fresh, ...this.events].sort((a, b) => b.time_ns - a.time_ns).slice(0, EVENTS_KEPT);
    this.changed("events");
  }

  /** @param {import("./types.js").Alarm[]} alarms */
  takeAlarms(alarms) {
    this.alarms = alarms;
    this.changed("alarms");
  }

  /** @param {import("./types.js").RecordingNote} recording */
  takeRecording(recording) {
    this.recording = recording;
    this.changed("recording");
  }

  /** The station says that a payload went. @param {string} id */
  takeGone(id) {
    this.payload(id).is_alive = false;
    this.changed("payload");
  }

  /** Whether what the page shows of a payload is of now. @param {Payload|null} payload */
  isLive(payload) {
    return Boolean(payload?.is_alive) && this.isTold(payload);
  }

  /** Whether the station still speaks of a payload. @param {Payload|null} payload */
  isTold(payload) {
    return this.link.phase === "open" && performance.now() - (payload?.told_ms ?? 0) < STALE_S * 1e3;
  }

  /** The state to show, which may be less than the last estimate's. @param {Payload|null} payload */
  stateOf(payload) {
    if (!payload) return this.link.phase === "open" ? "NONE" : "OFFLINE";
    if (!this.isTold(payload)) return "OFFLINE";
    if (!payload.is_alive) return "GONE";
    if (!payload.estimate) return "WAITING";
    if (this.playback) return payload.estimate.state;
    return performance.now() - payload.estimate_ms < STALE_S * 1e3 ? payload.estimate.state : "STALE";
  }
}
