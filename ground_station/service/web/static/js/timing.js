// @ts-check
/** Latencies, and what became of each frame. */
import { byId, fields, make, setAttribute, setText } from "./dom.js";
import { count, number } from "./format.js";
import { Series } from "./series.js";
import { Sparkline } from "./sparkline.js";

/** Name, label, whether it is a part of the row above, whether any of it is bad, and what it means. */
/** @type {[string, string, boolean, boolean, string][]} */
const FATES = [
  ["captured", "Captured", false, false, "by the camera"],
  ["gated", "gated", true, false, "said too little and were not sent"],
  ["sent", "sent", true, false, "left the encoder"],
  ["discarded", "discarded", true, true, "never left the encoder"],
  ["received", "Received", false, false, "arrived at the station, in whole or in parts"],
  ["damaged", "damaged", true, true, "arrived in parts; the localizer uses these"],
  ["lost", "lost", true, true, "did not arrive"],
  ["withheld", "withheld", true, true, "arrived, but rest on a picture that was lost"],
  ["skipped", "skipped", true, false, "a newer frame came before the localizer took them"],
  ["localized", "Localized", false, false, "solved from their own observations"],
];
const LATENCIES = 600; // of 60 s, ten a second at most
const TAKEN_MS = 100;

export class Panel {
  /** @param {import("./types.js").Shared} shared */
  constructor({ store, loop, theme, video }) {
    this.store = store;
    this.video = video;
    this.f = fields(byId("timing"));
    this.card = byId("frames");
    this.latency = { pose: new Series(LATENCIES), screen: new Series(LATENCIES) };
    this.taken_ms = { pose: 0, screen: 0 };
    this.lines = { pose: new Series(), screen: new Series() };
    /** @type {Sparkline[]} */
    this.sparks = [];
    for (const name of /** @type {("pose"|"screen")[]} */ (["pose", "screen"])) {
      const canvas = /** @type {HTMLCanvasElement} */ (this.f[`${name}-spark`]);
      this.sparks.push(new Sparkline(canvas, this.lines[name], theme, { most: 100, limit: 150 }));
    }
    /** @type {Record<string, {row: HTMLElement, total: HTMLElement, rate: HTMLElement, series: Series, before: number|null}>} */
    this.rows = {};
    this.counted_ms = performance.now();
    this.buildRows(theme);
    loop.add(["estimate"], () => this.takePose());
    loop.add(["video"], () => this.takeScreen());
    loop.add(["payload", "selection", "tick"], () => this.draw(), 500);
    loop.add(["sample", "theme"], () => this.sparks.forEach((spark) => spark.draw()));
  }

  /** @param {import("./theme.js").Theme} theme */
  buildRows(theme) {
    const body = byId("fates");
    for (const [name, label, is_part, , meaning] of FATES) {
      const canvas = /** @type {HTMLCanvasElement} */ (make("canvas", "spark"));
      const total = make("td", "", "–");
      const rate = make("td", "", "–");
      const row = make("tr", "", make("td", "", label), total, make("td", "", canvas), rate);
      row.title = meaning;
      setAttribute(row, "data-part", is_part ? "" : null);
      body.append(row);
      const series = new Series();
      this.rows[name] = { row, total, rate, series, before: null };
      this.sparks.push(new Sparkline(canvas, series, theme, { most: is_part && name !== "sent" ? 3 : 30 }));
    }
  }

  /** The shown payload's counters by fate. @returns {Record<string, number|undefined>} */
  counters() {
    const payload = this.store.current;
    const frames = payload?.note?.frames ?? {};
    const estimate = payload?.estimate;
    const skipped = (frames.dropped ?? 0) + (estimate?.skipped ?? 0);
    return { ...frames, skipped: payload?.note || estimate ? skipped : undefined, localized: estimate?.localized };
  }

  takePose() {
    const estimate = this.store.current?.estimate;
    if (estimate?.capture_ns == null) return;
    this.add("pose", (estimate.done_ns - estimate.capture_ns) / 1e6);
  }

  takeScreen() {
    this.add("screen", this.video.latency_ms);
  }

  /** @param {"pose"|"screen"} name @param {number} ms */
  add(name, ms) {
    const now_ms = performance.now();
    if (!Number.isFinite(ms) || now_ms - this.taken_ms[name] < TAKEN_MS) return;
    this.taken_ms[name] = now_ms;
    this.latency[name].add(ms);
  }

  /** Twice a second. */
  sample() {
    const now_ms = performance.now();
    const span_s = (now_ms - this.counted_ms) / 1e3;
    this.counted_ms = now_ms;
    const counters = this.counters();
    const is_live = this.store.isLive(this.store.current);
    for (const [name] of FATES) {
      const row = this.rows[name];
      const total = counters[name];
      const grown = total !== undefined && row.before !== null ? total - row.before : NaN;
      row.series.add(is_live && grown >= 0 ? grown / span_s : NaN);
      row.before = total ?? null;
    }
    for (const name of /** @type {("pose"|"screen")[]} */ (["pose", "screen"])) {
      const is_fresh = now_ms - this.taken_ms[name] < 1000;
      const ring = this.latency[name];
      this.lines[name].add(is_fresh ? ring.at(ring.values.length - 1) : NaN);
    }
  }

  /** Another payload. */
  clear() {
    for (const series of [...Object.values(this.latency), ...Object.values(this.lines)]) series.clear();
    for (const row of Object.values(this.rows)) {
      row.series.clear();
      row.before = null;
    }
  }

  draw() {
    const { f, store } = this;
    for (const name of /** @type {("pose"|"screen")[]} */ (["pose", "screen"])) {
      setText(f[name], number(this.latency[name].quantile(0.5)));
      setText(f[`${name}99`], number(this.latency[name].quantile(0.99)));
    }
    const counters = this.counters();
    const is_live = store.isLive(store.current);
    setAttribute(this.card, "data-stale", store.current && !is_live ? "true" : null);
    for (const [name, , , is_bad] of FATES) {
      const row = this.rows[name];
      setText(row.total, count(counters[name]));
      setAttribute(row.row, "data-bad", is_bad && (counters[name] ?? 0) > 0 ? "" : null);
      setText(row.rate, number(recent(row.series), 0));
    }
  }
}

/** Mean of the last two seconds, as counters come twice a second. @param {Series} series */
function recent(series) {
  const last = [1, 2, 3, 4].map((back) => series.at(series.values.length - back)).filter((value) => !Number.isNaN(value));
  return last.length ? last.reduce((a, b) => a + b) / last.length : NaN;
}
