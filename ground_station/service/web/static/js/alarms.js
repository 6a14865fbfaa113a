// @ts-check
/** Alarms: a band that stays until its cause is gone, the title, and a sound where it is wanted. */
import { byId, icon, make, setAttribute, setIcon, setText } from "./dom.js";
import { LEVEL_ICONS, rank } from "./events.js";
import { clockTime } from "./format.js";
import { Sound } from "./sound.js";

/** @typedef {import("./types.js").Alarm} Alarm */

const OFFLINE_MS = 2000; // a station that is restarted is back before

export class Alarms {
  /** @param {import("./store.js").Store} store @param {import("./loop.js").Loop} loop */
  constructor(store, loop) {
    this.store = store;
    this.loop = loop;
    this.band = byId("alarms");
    this.spoken = byId("say");
    this.sound = new Sound();
    /** Acknowledged ones by id, with the level that was. @type {Map<string, string>} */
    this.seen = new Map();
    /** @type {Map<string, {node: HTMLElement, text: HTMLElement, button: HTMLElement, icon: Element}>} */
    this.rows = new Map();
    this.button = byId("sound");
    this.button.addEventListener("click", () => this.turnSound());
    loop.add(["alarms", "station", "connection"], () => this.draw(), 100);
  }

  turnSound() {
    this.sound.turn(!this.sound.is_on);
    setAttribute(this.button, "aria-pressed", String(this.sound.is_on));
    const symbol = this.button.querySelector("svg");
    if (symbol) setIcon(symbol, this.sound.is_on ? "sound-on" : "sound-off");
    this.ring();
  }

  /** @param {Alarm} alarm */
  isSeen(alarm) {
    return this.seen.get(alarm.id) === alarm.level;
  }

  /** @param {Alarm[]} alarms */
  acknowledge(alarms) {
    for (const alarm of alarms) this.seen.set(alarm.id, alarm.level);
    this.loop.mark("alarms");
  }

  acknowledgeAll() {
    this.acknowledge(this.store.alarms);
  }

  draw() {
    const alarms = [...this.store.alarms].sort(
      (a, b) => Number(this.isSeen(a)) - Number(this.isSeen(b)) || rank(b.level) - rank(a.level) || a.since_ns - b.since_ns,
    );
    const standing = new Set(alarms.map((alarm) => alarm.id));
    for (const id of [...this.seen.keys()]) if (!standing.has(id)) this.seen.delete(id); // when it comes again, it is new
    for (const [id, row] of this.rows) {
      if (standing.has(id)) continue;
      row.node.remove();
      this.rows.delete(id);
    }
    alarms.forEach((alarm, k) => {
      const row = this.rows.get(alarm.id) ?? this.row(alarm);
      const is_seen = this.isSeen(alarm);
      setAttribute(row.node, "data-level", alarm.level);
      setAttribute(row.node, "data-seen", is_seen ? "" : null);
      setIcon(row.icon, LEVEL_ICONS[alarm.level] ?? "info");
      setText(row.text, sentence(alarm));
      row.button.hidden = is_seen || rank(alarm.level) === 0;
      if (this.band.children[k] !== row.node) this.band.insertBefore(row.node, this.band.children[k] ?? null);
    });
    this.title(alarms);
    this.ring();
  }

  /** @param {Alarm} alarm */
  row(alarm) {
    const text = make("span", "", "");
    const since = make("time", "", `since ${clockTime(alarm.since_ns / 1e6)}`);
    const button = make("button", "", "Acknowledge");
    button.setAttribute("type", "button");
    button.addEventListener("click", () => this.acknowledge(this.store.alarms.filter((one) => one.id === alarm.id)));
    const symbol = icon("info");
    const node = make("div", "alarm", symbol, text, since, button);
    node.dataset.id = alarm.id;
    const row = { node, text, button, icon: symbol };
    this.rows.set(alarm.id, row);
    if (rank(alarm.level) > 0) setText(this.spoken, sentence(alarm));
    return row;
  }

  /** @param {Alarm[]} alarms */
  title(alarms) {
    const name = this.store.station.name || "Blimp ground station";
    const loud = alarms.filter((alarm) => rank(alarm.level) === 2);
    const first = loud[0] ?? alarms.find((alarm) => rank(alarm.level) === 1);
    const more = loud.length > 1 ? ` (+${loud.length - 1})` : "";
    const sign = loud.length ? "⚠" : "△";
    if (this.isOffline()) {
      document.title = `⚠ No connection · ${name}`;
      return;
    }
    document.title = first ? `${sign} ${sentence(first)}${more} · ${name}` : name;
  }

  ring() {
    const is_loud = this.store.alarms.some((alarm) => rank(alarm.level) === 2 && !this.isSeen(alarm));
    this.sound.ring((is_loud && !this.store.playback) || this.isOffline());
  }

  isOffline() {
    return this.store.link.phase !== "open" && performance.now() - this.store.link.since_ms > OFFLINE_MS;
  }
}

/** @param {Alarm} alarm */
function sentence(alarm) {
  const text = alarm.text.charAt(0).toUpperCase() + alarm.text.slice(1);
  return alarm.payload && alarm.payload !== "-" ? `${alarm.payload}: ${text}` : text;
}
