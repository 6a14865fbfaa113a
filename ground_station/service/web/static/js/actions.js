// @ts-check
/** The commands: each button shows that it works, is done, or was refused and why. */
import * as api from "./api.js";
import { byId, fields, setAttribute, setIcon, setText, show } from "./dom.js";
import { size, stopwatch } from "./format.js";

const DONE_MS = 3000;
const REFUSED_MS = 12_000;

/** @typedef {"record"|"relocalize"|"map"|"payload-record"|"idr"|"power"} Name */

export class Actions {
  /** @param {import("./store.js").Store} store @param {import("./loop.js").Loop} loop @param {{map: () => void, power: () => void}} open dialogs */
  constructor(store, loop, open) {
    this.store = store;
    this.outcome = byId("outcome");
    this.outcomeText = fields(this.outcome).text;
    this.clear = 0;
    /** @type {Record<string, {node: HTMLButtonElement, f: Record<string, HTMLElement>, icon: Element, timer: number}>} */
    this.buttons = {};
    /** @type {Record<Name, () => void>} */
    this.acts = {
      record: () => this.record(),
      relocalize: () => this.ofPayload("relocalize", "Relocalize", (id) => api.relocalize(id)),
      map: open.map,
      "payload-record": () => this.payloadRecord(),
      idr: () => this.ofPayload("idr", "Refresh", (id) => api.command(id, "idr")),
      power: open.power,
    };
    for (const [name, act] of Object.entries(this.acts)) {
      const node = /** @type {HTMLButtonElement} */ (byId(`act-${name}`));
      const symbol = node.querySelector("svg");
      if (!symbol) continue;
      this.buttons[name] = { node, f: fields(node), icon: symbol, timer: 0 };
      node.addEventListener("click", () => node.disabled || act());
    }
    loop.add(["recording", "payload", "selection", "connection", "tick", "estimate"], () => this.draw(), 250);
  }

  record() {
    const is_active = Boolean(this.store.recording?.active);
    this.run("record", is_active ? "Stop recording" : "Record", () => api.record(!is_active));
  }

  payloadRecord() {
    const is_active = Boolean(this.store.current?.note?.recording);
    const name = is_active ? "record-stop" : "record-start";
    this.ofPayload("payload-record", is_active ? "Stop recording on payload" : "Record on payload", (id) => api.command(id, name));
  }

  /** @param {Name} name @param {string} label @param {(id: string) => Promise<import("./types.js").Answer>} ask */
  ofPayload(name, label, ask) {
    const id = this.store.selected;
    if (id) this.run(name, `${label}, ${id}`, () => ask(id));
  }

  /**
   * @param {Name} name of the button @param {string} label
   * @param {() => Promise<import("./types.js").Answer>} ask
   */
  async run(name, label, ask) {
    const button = this.buttons[name];
    if (button.node.dataset.phase === "working") return; // a second press changes nothing
    clearTimeout(button.timer);
    setAttribute(button.node, "data-phase", "working");
    setAttribute(button.node, "aria-busy", "true");
    this.say("working", `${label}: asking…`, 0);
    const answer = await ask();
    const phase = answer.done ? "done" : "refused";
    setAttribute(button.node, "data-phase", phase);
    setAttribute(button.node, "aria-busy", null);
    this.say(phase, answer.done ? `${label}: done${answer.reason ? `, ${answer.reason}` : ""}` : `${label}: refused: ${answer.reason || "no reason given"}`, answer.done ? DONE_MS : REFUSED_MS);
    button.timer = setTimeout(() => setAttribute(button.node, "data-phase", null), answer.done ? DONE_MS : REFUSED_MS);
  }

  /** @param {string} phase @param {string} text @param {number} for_ms 0: until something else */
  say(phase, text, for_ms) {
    clearTimeout(this.clear);
    show(this.outcome, true);
    setAttribute(this.outcome, "data-phase", phase);
    const symbol = this.outcome.querySelector("svg");
    if (symbol) setIcon(symbol, phase === "done" ? "check" : phase === "refused" ? "lost" : "info");
    setText(this.outcomeText, text);
    if (for_ms) this.clear = setTimeout(() => show(this.outcome, false), for_ms);
  }

  draw() {
    const { store } = this;
    const is_open = store.link.phase === "open";
    const is_live = store.isLive(store.current);
    this.drawRecord(is_open);
    const card = this.buttons["payload-record"];
    const file = store.current?.note?.recording ?? "";
    setAttribute(card.node, "data-on", file && is_live ? "" : null);
    setIcon(card.icon, file && is_live ? "stop" : "card");
    setText(card.f.label, file && is_live ? "Stop" : "Record");
    setText(card.f.detail, file && is_live ? "on payload: on" : "on payload");
    setText(this.buttons.map.f.detail, store.current?.estimate?.map || store.station.map || "–");
    for (const [name, button] of Object.entries(this.buttons)) {
      // What the payload does needs a payload; a localizer may be asked for an old one, too.
      button.node.disabled = !is_open || Boolean(store.playback) || (name !== "record" && !is_live);
    }
  }

  /** @param {boolean} is_open */
  drawRecord(is_open) {
    const { node, f, icon } = this.buttons.record;
    const note = this.store.recording;
    const is_on = Boolean(note?.active);
    setAttribute(node, "data-on", is_on && is_open ? "" : null);
    setIcon(icon, is_on ? "stop" : "record");
    setText(f.label, is_on ? `Stop ${stopwatch(note?.duration_s ?? 0)}` : "Record");
    const detail = note?.problem ? note.problem : is_on ? size(note?.size_MB) : note?.free_MB != null ? `${size(note.free_MB)} free` : "ground station";
    setText(f.detail, detail);
    node.title = is_on && note?.file ? `Stop recording ${note.file} (R)` : "Record everything on the ground station (R)";
  }
}
