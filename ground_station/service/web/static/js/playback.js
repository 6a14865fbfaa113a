// @ts-check
/**
 * A recording in place of the live flight: its time line with the alarms of then, and the way back.
 *
 * The station plays it over the live channel's own messages, so that every view shows it as it was.
 * What is live meanwhile is not shown: its alarms are counted on the way back to it.
 */
import * as api from "./api.js";
import { byId, fields, make, setAttribute, setIcon, setText, show } from "./dom.js";
import { dateTime, stopwatch } from "./format.js";

const SEEK_MS = 120; // so often while the time line is drawn along
const LIVE_MS = 3000;

/** @typedef {{at_s: number, level: string, payload: string, text: string}} Mark */

export class Playback {
  /** @param {import("./store.js").Store} store @param {(message: Record<string, any>) => void} send @param {() => void} turned to another source, which is to be connected */
  constructor(store, send, turned) {
    this.store = store;
    this.send = send;
    this.turned = turned;
    this.file = this.station = "";
    this.begin_ms = NaN;
    this.sought_ms = 0;
    this.is_held = false; // the time line, by a finger
    this.bar = byId("tape");
    this.f = fields(this.bar);
    this.line = /** @type {HTMLInputElement} */ (this.f.line);
    this.f.play.addEventListener("click", () => this.toggle());
    this.f.live.addEventListener("click", () => this.leave());
    this.f.rate.addEventListener("change", () => this.send({ type: "rate", rate: Number(/** @type {HTMLSelectElement} */ (this.f.rate).value) }));
    this.line.addEventListener("input", () => this.seek(Number(this.line.value), SEEK_MS));
    this.line.addEventListener("change", () => this.seek(Number(this.line.value), 0));
    for (const [name, is_held] of /** @type {[string, boolean][]} */ ([["pointerdown", true], ["pointerup", false], ["pointercancel", false]])) {
      this.line.addEventListener(name, () => (this.is_held = is_held));
    }
    setInterval(() => this.file && this.countLive(), LIVE_MS);
  }

  /** Where its messages come from; empty: the live ones. */
  get path() {
    return this.file && `${api.recordingPath(this.file, this.station)}/play`;
  }

  /** @param {string} file @param {string} station where it lies; empty: here */
  open(file, station) {
    this.file = file;
    this.station = station;
    show(this.bar, true);
    setText(this.f.file, `Reading ${file}…`);
    setText(this.f.live, "Back to live");
    this.f.marks.replaceChildren();
    /** @type {HTMLSelectElement} */ (this.f.rate).value = "1";
    this.turned();
  }

  leave() {
    if (!this.file) return;
    this.file = "";
    show(this.bar, false);
    this.turned();
  }

  /** The station's greeting, at each time that was sought. @param {{begin_ns: number, length_s: number, marks: Mark[]}|undefined} tape */
  take(tape) {
    if (!tape) return;
    this.begin_ms = tape.begin_ns / 1e6;
    this.line.max = String(tape.length_s);
    setText(this.f.length, stopwatch(tape.length_s));
    if (this.f.marks.childElementCount !== tape.marks.length) this.f.marks.replaceChildren(...tape.marks.map((mark) => this.mark(mark, tape.length_s)));
  }

  /** @param {Mark} mark @param {number} length_s */
  mark(mark, length_s) {
    const node = make("button", "tape-mark");
    const who = mark.payload === "-" ? "" : `${mark.payload}: `;
    node.setAttribute("type", "button");
    node.title = `${stopwatch(mark.at_s)} ${who}${mark.text}`;
    node.setAttribute("aria-label", node.title);
    node.dataset.level = mark.level;
    node.style.left = `${(100 * mark.at_s) / Math.max(length_s, 0.1)}%`;
    node.addEventListener("click", () => this.seek(Math.max(0, mark.at_s - 2), 0));
    return node;
  }

  /** Where it is now. @param {{at_s: number, playing: boolean, rate: number}|undefined} playback */
  show(playback) {
    if (!playback || !this.file) return;
    if (!this.is_held) this.line.value = String(playback.at_s);
    setText(this.f.time, stopwatch(playback.at_s));
    setAttribute(this.line, "aria-valuetext", stopwatch(playback.at_s));
    setText(this.f.file, `${this.file} · ${dateTime(this.begin_ms + 1e3 * playback.at_s)}`);
    const symbol = this.f.play.querySelector("svg");
    if (symbol) setIcon(symbol, playback.playing ? "pause" : "play");
  }

  toggle() {
    if (this.file) this.send({ type: "play", on: !this.store.playback?.playing });
  }

  /** @param {number} at_s @param {number} least_ms since the one before */
  seek(at_s, least_ms) {
    const now_ms = performance.now();
    if (now_ms - this.sought_ms < least_ms) return;
    this.sought_ms = now_ms;
    this.send({ type: "seek", at_s });
  }

  async countLive() {
    try {
      const { alarms } = await api.get("/api/state");
      const loud = alarms.filter((/** @type {import("./types.js").Alarm} */ alarm) => alarm.level !== "info").length;
      setText(this.f.live, loud ? `Back to live: ${loud} alarm${loud > 1 ? "s" : ""}` : "Back to live");
      setAttribute(this.f.live, "data-loud", loud ? "" : null);
    } catch {
      // The connection says that the station is gone.
    }
  }
}
