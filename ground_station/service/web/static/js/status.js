// @ts-check
/** The bar and the banners: payloads to choose from, connection, clock, demo. */
import { byId, fields, icon, make, setAttribute, setIcon, setText, show } from "./dom.js";
import { clockTime, duration, number, percent } from "./format.js";
import { lookOf } from "./states.js";

const PATIENCE_MS = 1200; // a connection that is back sooner is not worth a banner

export class Status {
  /** @param {import("./store.js").Store} store @param {import("./loop.js").Loop} loop @param {(id: string) => void} choose */
  constructor(store, loop, choose) {
    this.store = store;
    this.choose = choose;
    this.link = byId("link");
    this.linkText = fields(this.link).text;
    this.offline = byId("offline");
    this.offlineFields = fields(this.offline);
    this.list = byId("payloads");
    /** @type {Map<string, {node: HTMLElement, icon: Element, name: Element, word: Element, facts: HTMLElement}>} */
    this.choices = new Map();
    this.list.addEventListener("keydown", (event) => this.step(event));
    loop.add(["connection", "tick", "station"], () => this.drawConnection(), 200);
    loop.add(["payloads", "payload", "tick", "selection", "estimate"], () => this.drawPayloads(), 250);
    loop.add(["station"], () => this.drawStation());
  }

  drawStation() {
    const { station } = this.store;
    setText(byId("station-name"), [station.name || "Ground station", ...this.store.otherStations()].join(" + "));
    show(byId("demo"), Boolean(station.demo));
    setText(byId("version"), station.version ? `Ground station ${station.version}` : "");
  }

  drawConnection() {
    const { link, clock } = this.store;
    const now_ms = performance.now();
    setText(byId("clock"), clockTime(clock.now_ms()));
    setAttribute(this.link, "data-phase", link.phase);
    setText(this.linkText, { open: "Connected", connecting: "Connecting", waiting: "Off", refused: "Signed out" }[link.phase]);
    const off_ms = now_ms - link.since_ms;
    const is_off = link.phase !== "open" && off_ms > PATIENCE_MS;
    show(this.offline, is_off);
    if (!is_off) return;
    const since = Number.isFinite(clock.offset_ms) ? ` since ${clockTime(link.since_ms + clock.offset_ms)}` : "";
    setText(this.offlineFields.title, `No connection to the station${since}`);
    const wait_s = Math.max(0, Math.ceil((link.retry_ms - now_ms) / 1e3));
    const next = link.phase === "waiting" && wait_s ? `next try in ${wait_s} s` : "trying";
    const why = link.reason ? `${link.reason} · ` : "";
    setText(this.offlineFields.text, `· ${duration(off_ms / 1e3)} · ${why}${next}`);
  }

  drawPayloads() {
    const { store } = this;
    for (const payload of store.payloads.values()) {
      const choice = this.choices.get(payload.id) ?? this.add(payload.id);
      const state = store.stateOf(payload);
      const look = lookOf(state);
      const is_chosen = payload.id === store.selected;
      setAttribute(choice.node, "data-state", look.key);
      setAttribute(choice.node, "aria-checked", String(is_chosen));
      setAttribute(choice.node, "tabindex", is_chosen ? "0" : "-1");
      const at = payload.note?.relayed ? payload.note.station : "";
      const words = `${look.word}${at ? `, with station ${at}` : ""}`;
      setAttribute(choice.node, "aria-label", `${payload.id}, ${words}`);
      setAttribute(choice.node, "title", `${payload.id}: ${words}`);
      setIcon(choice.icon, look.icon);
      setText(choice.name, at ? `${payload.id} · ${at}` : payload.id);
      setText(choice.word, look.word);
      show(choice.facts, store.payloads.size > 1);
      const battery = payload.stale.includes("battery") ? null : payload.note?.battery;
      const height_m = look.key === "tracking" || look.key === "degraded" ? payload.estimate?.height_m : null;
      setText(choice.facts, `${number(height_m, 1)} m · ${percent(battery?.percentage)}`);
      setAttribute(choice.facts, "data-bad", battery?.alarm ? "" : null);
    }
    for (const [id, choice] of this.choices) {
      if (store.payloads.has(id)) continue;
      choice.node.remove();
      this.choices.delete(id);
    }
  }

  /** @param {string} id */
  add(id) {
    const symbol = icon("none");
    const name = make("span", "", id);
    const word = make("i", "", "");
    const facts = make("small");
    const node = make("button", "payload", symbol, make("span", "who", name, facts), word);
    node.setAttribute("type", "button");
    node.setAttribute("role", "radio");
    node.addEventListener("click", () => this.choose(id));
    this.list.append(node);
    const choice = { node, icon: symbol, name, word, facts };
    this.choices.set(id, choice);
    return choice;
  }

  /** Arrow keys in the group, as in any group of radio buttons. @param {KeyboardEvent} event */
  step(event) {
    const by = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
    if (!by) return;
    event.preventDefault();
    const ids = [...this.choices.keys()];
    const next = ids[(ids.indexOf(this.store.selected) + by + ids.length) % ids.length];
    this.choose(next);
    this.choices.get(next)?.node.focus();
  }
}
