// @ts-check
/** Battery, radio and board of the shown payload. */
import { byId, fields, setAttribute, setText } from "./dom.js";
import { duration, number, percent, size, UNKNOWN } from "./format.js";
import { Series } from "./series.js";
import { Sparkline } from "./sparkline.js";

const BARS_DBM = [-85, -75, -67, -58]; // one bar: barely; four: as near as it needs to be
const HOT_C = 80; // the Pi slows down from here on
const LOSS_BAD = 0.02;

export class Panel {
  /** @param {import("./types.js").Shared} shared */
  constructor({ store, loop, theme }) {
    this.store = store;
    this.cards = { battery: byId("battery"), radio: byId("radio"), board: byId("board") };
    this.battery = fields(this.cards.battery);
    this.bar = byId("bar-battery");
    this.inBar = fields(this.bar);
    this.radio = fields(this.cards.radio);
    this.board = fields(this.cards.board);
    this.series = { loss: new Series(), rate: new Series(), heat: new Series() };
    const canvas = (/** @type {HTMLElement} */ node) => /** @type {HTMLCanvasElement} */ (node);
    this.sparks = [
      new Sparkline(canvas(this.radio["loss-spark"]), this.series.loss, theme, { most: 5, limit: 100 * LOSS_BAD }),
      new Sparkline(canvas(this.radio["rate-spark"]), this.series.rate, theme, { most: 1000 }),
      new Sparkline(canvas(this.board["heat-spark"]), this.series.heat, theme, { least: 20, most: 85, limit: HOT_C }),
    ];
    loop.add(["payload", "selection", "tick"], () => this.draw(), 250);
    loop.add(["sample", "theme"], () => this.sparks.forEach((spark) => spark.draw()));
  }

  /** Twice a second. */
  sample() {
    const payload = this.store.current;
    const note = this.store.isLive(payload) ? payload?.note : null;
    this.series.loss.add(note?.lost_share != null ? 100 * note.lost_share : NaN);
    this.series.rate.add(note?.bitrate_kbps ?? NaN);
    this.series.heat.add(payload?.stale.includes("health") ? NaN : (note?.health?.temperature_C ?? NaN));
  }

  clear() {
    for (const series of Object.values(this.series)) series.clear();
  }

  draw() {
    const payload = this.store.current;
    const is_live = this.store.isLive(payload);
    const stale = (/** @type {string} */ name) => !is_live || Boolean(payload?.stale.includes(name));
    const note = payload?.note;
    const told_s = (performance.now() - (payload?.told_ms ?? 0)) / 1e3;
    const age_s = (/** @type {string} */ name) => (payload?.age_s[name] == null ? null : payload.age_s[name] + told_s);
    this.drawBattery(note?.battery, stale("battery"), age_s("battery"));
    this.drawRadio(note, !is_live, stale("health"));
    this.drawBoard(note, stale("health"), age_s("health"));
  }

  /** @param {Record<string, any>|null|undefined} battery @param {boolean} is_stale @param {number|null|undefined} age_s */
  drawBattery(battery, is_stale, age_s) {
    const f = this.battery;
    setAttribute(this.cards.battery, "data-stale", battery && is_stale ? "true" : null);
    setAttribute(this.cards.battery, "data-alarm", !is_stale && battery?.alarm ? battery.alarm : null);
    setText(f.age, !battery ? "no gauge heard" : is_stale ? old(age_s) : ALARMS[battery.alarm] ?? STATUS[battery.power_supply_status] ?? "");
    setText(f.percent, number(battery?.percentage == null ? NaN : 100 * battery.percentage));
    setText(f.left, number(battery?.time_left_s == null ? NaN : battery.time_left_s / 60));
    setText(f.volts, number(battery?.voltage, 2));
    setText(f.amperes, number(battery?.current, 2));
    setAttribute(f.meter, "value", String(battery?.percentage ?? 0));
    for (const name of ["data-stale", "data-alarm"]) setAttribute(this.bar, name, this.cards.battery.getAttribute(name));
    setAttribute(this.inBar.fill, "width", String(28 * Math.min(1, battery?.percentage ?? 0)));
    setText(this.inBar.percent, percent(battery?.percentage));
  }

  /** @param {import("./types.js").PayloadNote|null|undefined} note @param {boolean} is_stale @param {boolean} old_health */
  drawRadio(note, is_stale, old_health) {
    const f = this.radio;
    const health = note?.health;
    setAttribute(this.cards.radio, "data-stale", note && is_stale ? "true" : null);
    setText(f.secure, note ? (note.encrypted ? "encrypted" : "not encrypted") : "");
    const signal = old_health ? NaN : health?.wifi_signal_dBm ?? NaN;
    setText(f.signal, number(signal));
    BARS_DBM.forEach((least, k) => setAttribute(f[`bar${k + 1}`], "data-on", signal >= least ? "" : null));
    setText(f.loss, number(note?.lost_share == null ? NaN : 100 * note.lost_share, 1));
    setText(f.bitrate, number(note?.bitrate_kbps));
    setText(f.trip, number(note?.round_trip_s == null ? NaN : 1e3 * note.round_trip_s, 1));
  }

  /** @param {import("./types.js").PayloadNote|null|undefined} note @param {boolean} is_stale @param {number|null|undefined} age_s */
  drawBoard(note, is_stale, age_s) {
    const f = this.board;
    const health = note?.health;
    setAttribute(this.cards.board, "data-stale", health && is_stale ? "true" : null);
    setText(f.age, !health ? "no health heard" : is_stale ? old(age_s) : `up ${duration(health.uptime_s)}`);
    setText(f.heat, number(health?.temperature_C));
    const throttled = health?.throttled;
    setText(f.throttled, throttled == null ? UNKNOWN : throttled.length ? throttled.join(", ") : "none");
    setAttribute(f.throttled, "data-bad", throttled?.length ? "" : null);
    setAttribute(f.throttled, "title", throttled?.length ? throttled.join(", ") : null);
    setText(f.cpu, health?.cpu == null ? UNKNOWN : number(100 * health.cpu));
    const free = health?.disk_free_MB == null ? "" : `${size(health.disk_free_MB)} free`;
    setText(f.card, health?.recording ? `recording ${size(health.recording_MB)}` : free || UNKNOWN);
    setText(f.autopilot, autopilot(note?.autopilot));
    const trouble = firmware(health, this.store.station.version);
    setText(f.version, health?.version ? (health.release === "fell back" ? `fell back to ${health.version}` : health.version) : UNKNOWN);
    setAttribute(f.version, "data-bad", trouble ? "" : null);
    setAttribute(f.version, "title", trouble ? `${health?.version}: ${trouble}` : health?.version || null);
  }
}

/** @type {Record<string, string>} */
const ALARMS = { low: "low", critical: "critical" };
/** Of ROS `sensor_msgs/BatteryState`. @type {Record<number, string>} */
const STATUS = { 1: "charging", 2: "discharging", 3: "not charging", 4: "full" };

/** What is wrong with the firmware's version. @param {Record<string, any>|null|undefined} health @param {string|undefined} own */
function firmware(health, own) {
  if (!health?.version) return "";
  if (health.release === "fell back") return health.release_reason || "an update did not stay";
  return own && health.version.split(/[ +]/)[0] !== own ? `the ground station is ${own}` : "";
}

/** @param {number|null|undefined} age_s */
function old(age_s) {
  return age_s == null ? "not heard" : `${duration(age_s)} old`;
}

/** @param {Record<string, any>|null|undefined} autopilot */
function autopilot(autopilot) {
  if (!autopilot) return UNKNOWN;
  if (!autopilot.connected) return autopilot.reason ? `off: ${autopilot.reason}` : "not connected";
  const battery = autopilot.battery_percentage == null ? "" : `, ${percent(autopilot.battery_percentage)}`;
  return (autopilot.armed == null ? "connected" : autopilot.armed ? "armed" : "disarmed") + battery;
}
