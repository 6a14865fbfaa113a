// @ts-check
/** The event log: newest first, bounded, only what is new touches the document. */
import { byId, icon, make, setAttribute, setText } from "./dom.js";
import { clockTime, dateTime } from "./format.js";

const ROWS = 200;
const RANK = { info: 0, warning: 1, alarm: 2 };
/** @type {Record<string, string>} */
export const LEVEL_ICONS = { info: "info", warning: "degraded", alarm: "lost" };

export class Panel {
  /** @param {import("./types.js").Shared} shared */
  constructor({ store, loop }) {
    this.store = store;
    this.loop = loop;
    this.log = byId("log");
    this.least = 0;
    /** @type {Map<import("./types.js").Event, HTMLElement>} */
    this.rows = new Map();
    this.buttons = [.../** @type {NodeListOf<HTMLElement>} */ (document.querySelectorAll(".events .tools [data-level]"))];
    for (const button of this.buttons) {
      button.addEventListener("click", () => this.filter(button.dataset.level ?? "info"));
    }
    loop.add(["events"], () => this.draw(), 200);
  }

  /** @param {string} level the least that is shown */
  filter(level) {
    this.least = rank(level);
    for (const button of this.buttons) setAttribute(button, "aria-pressed", String(button.dataset.level === level));
    this.log.scrollTop = 0;
    this.loop.mark("events");
  }

  draw() {
    const wanted = this.store.events.filter((event) => rank(event.level) >= this.least).slice(0, ROWS);
    const keep = new Set(wanted);
    for (const [event, row] of this.rows) {
      if (keep.has(event)) continue;
      row.remove();
      this.rows.delete(event);
    }
    let after = this.log.firstChild;
    for (const event of wanted) {
      const row = this.rows.get(event) ?? this.row(event);
      if (row === after) after = after.nextSibling;
      else this.log.insertBefore(row, after);
    }
    while (after) {
      const next = after.nextSibling;
      if (!this.rowsHave(after)) after.remove();
      after = next;
    }
    if (!wanted.length) this.log.replaceChildren(make("li", "log-empty", this.least ? "Nothing of this level" : "No events yet"));
    const all = this.store.events.length;
    setText(byId("events-count"), this.least ? `${wanted.length} of ${all}` : `${all}`);
  }

  /** @param {Node} node */
  rowsHave(node) {
    for (const row of this.rows.values()) if (row === node) return true;
    return false;
  }

  /** @param {import("./types.js").Event} event */
  row(event) {
    const ms = event.time_ns / 1e6;
    const time = make("time", "", clockTime(ms));
    time.title = dateTime(ms);
    const of_payload = event.payload && event.payload !== "-";
    const where = make("span", "source", of_payload ? /** @type {string} */ (event.payload) : event.source);
    where.title = of_payload ? `${event.payload}, ${event.source}` : event.source;
    const text = make("span", "text", make("span", "hidden", `${event.level}: `), event.text || event.name);
    text.title = event.name;
    const row = make("li", "event", icon(LEVEL_ICONS[event.level] ?? "info"), time, where, text);
    row.dataset.level = event.level;
    this.rows.set(event, row);
    return row;
  }
}

/** @param {string} level */
export function rank(level) {
  return RANK[/** @type {keyof typeof RANK} */ (level)] ?? 0;
}
