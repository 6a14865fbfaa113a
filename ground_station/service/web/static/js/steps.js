// @ts-check
/** The steps from payload to flight, and the long jobs that are started from them. */
import * as api from "./api.js";
import { dialog } from "./dialogs.js";
import { byId, fields, icon, make, setAttribute, setText, show } from "./dom.js";
import { percent } from "./format.js";

const AGAIN_MS = 4000;
const ENDED_MS = 60_000; // so long is told how a job ended
const STATES = { done: ["check", "done"], ready: ["initializing", "to do"], waiting: ["none", "later"] };
const JOBS = { calibrate: "Calibrate with", build: "Build a map of", register: "Register", extend: "Extend the map by" };
const NAMED = ["build", "extend"]; // these make a map

export class Steps {
  /** @param {import("./store.js").Store} store @param {import("./loop.js").Loop} loop */
  constructor(store, loop) {
    this.store = store;
    this.dialog = dialog("steps-dialog");
    this.f = fields(this.dialog);
    this.banner = byId("job");
    this.b = fields(this.banner);
    this.told = "";
    this.ended_ms = 0;
    this.was_running = false;
    byId("steps-open").addEventListener("click", () => this.open());
    this.b.end.addEventListener("click", () => this.end());
    setInterval(() => this.dialog.open && this.load(), AGAIN_MS);
    loop.add(["job", "tick"], () => this.drawJob(), 250);
  }

  open() {
    if (this.dialog.open) return;
    this.told = "";
    setText(this.f.note, "Asking the station…");
    this.f.list.replaceChildren();
    this.dialog.showModal();
    this.load();
  }

  /** Draws again only what is new: nobody's choice is taken back. */
  async load() {
    try {
      /** @type {{folder: string, steps: import("./types.js").Step[]}} */
      const guide = await api.get("/api/guide");
      const text = JSON.stringify(guide);
      if (text === this.told) return;
      this.told = text;
      setText(this.f.note, `Commands are given in ${guide.folder}, where the station runs; blimp init shows the same.`);
      this.f.list.replaceChildren(...guide.steps.map((step) => this.row(step)));
    } catch (error) {
      setText(this.f.note, error instanceof Error ? error.message : String(error));
    }
  }

  /** @param {import("./types.js").Step} step */
  row(step) {
    const [symbol, word] = STATES[step.state];
    const state = make("span", "step-state", icon(symbol), word);
    const head = make("h3", "", make("span", "", step.title), state);
    const ways = make("div", "step-body");
    for (const way of step.ways) {
      ways.append(make("p", "way", way.text));
      if (way.command) ways.append(command(way.command));
    }
    if (step.choices.length) ways.append(this.starter(step));
    const again = make("details", "", make("summary", "", "Once more"), ways);
    const shown = step.state !== "done" ? ways : ways.hasChildNodes() ? again : "";
    const body = make("div", "step-body", make("p", "", step.found), shown, make("p", "step-check", `Check: ${step.check}`));
    const row = make("li", "step", head, body);
    row.dataset.state = step.state;
    return row;
  }

  /** A job of this step: of which recording or map, and the button. @param {import("./types.js").Step} step */
  starter(step) {
    const label = JOBS[/** @type {keyof typeof JOBS} */ (step.name)];
    const select = /** @type {HTMLSelectElement} */ (make("select"));
    for (const choice of step.choices) select.append(make("option", "", choice));
    select.setAttribute("aria-label", label);
    const name = /** @type {HTMLInputElement} */ (make("input"));
    name.placeholder = "its name";
    name.setAttribute("aria-label", "Name of the map");
    name.addEventListener("keydown", (event) => event.key === "Enter" && event.preventDefault());
    const button = make("button", "", "Start");
    button.setAttribute("type", "button");
    const outcome = make("p", "step-outcome", "");
    outcome.setAttribute("role", "status");
    button.addEventListener("click", async () => {
      const more = NAMED.includes(step.name) ? { map: name.value.trim() } : {};
      const answer = await api.post("/api/job", { step: step.name, choice: select.value, ...more });
      setText(outcome, answer.done ? "It runs, also when this page is closed." : answer.reason);
    });
    const parts = [make("span", "", label), select, ...(NAMED.includes(step.name) ? [name] : []), button];
    return make("div", "starter", ...parts, outcome);
  }

  /** Stops the job that runs, or puts away how the last one ended. */
  async end() {
    if (!this.store.job?.running) {
      this.ended_ms = 0;
      this.drawJob();
      return;
    }
    setText(this.b.line, "stopping…");
    await api.post("/api/job", {}, "DELETE");
  }

  drawJob() {
    const { job } = this.store;
    const now_ms = performance.now();
    if (this.was_running && !job?.running) this.ended_ms = now_ms;
    this.was_running = Boolean(job?.running);
    const is_told = Boolean(job && (job.running || (this.ended_ms && now_ms - this.ended_ms < ENDED_MS)));
    show(this.banner, is_told);
    if (!job || !is_told) return;
    const ending = job.status === 0 ? "is done" : job.status === null ? "was stopped" : "failed";
    setText(this.b.what, job.running ? job.command : `${job.command} ${ending}`);
    setText(this.b.line, job.share === null ? job.line : `${percent(job.share)} · ${job.line}`);
    setAttribute(this.banner, "data-phase", job.running ? "working" : job.status === 0 ? "done" : "refused");
    show(this.b.share, job.share !== null);
    if (job.share !== null) /** @type {HTMLProgressElement} */ (this.b.share).value = job.share;
    show(this.b.page, Boolean(job.page));
    setAttribute(this.b.page, "href", job.page || null);
    setText(this.b.end, job.running ? "Stop" : "Close");
  }
}

/** A command line that can be copied where the browser lets a page do so. @param {string} text */
function command(text) {
  const code = make("code", "", text);
  if (!navigator.clipboard) return make("div", "command", code);
  const button = make("button", "", "Copy");
  button.setAttribute("type", "button");
  button.setAttribute("aria-label", `Copy ${text}`);
  button.addEventListener("click", async () => {
    await navigator.clipboard.writeText(text);
    setText(button, "Copied");
  });
  return make("div", "command", code, button);
}
