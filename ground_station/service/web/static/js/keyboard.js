// @ts-check
/** Single keys for what an operator does often, and the page that names them. */
import { dialog } from "./dialogs.js";
import { byId, icon, make, setAttribute, setText } from "./dom.js";
import { recall, remember } from "./remembered.js";
import { lookOf } from "./states.js";

const STORED = "blimp.single-keys";

/** @typedef {{key: string, does: string, act?: () => void}} Shortcut `act` is absent where a view has its own keys */

export class Keyboard {
  /** @param {Shortcut[]} shortcuts @param {(digit: number) => void} choose the payload of a number */
  constructor(shortcuts, choose) {
    this.shortcuts = shortcuts;
    this.choose = choose;
    this.help = dialog("help-dialog");
    this.is_on = recall(STORED) !== "off";
    this.toggle = byId("keys-toggle");
    this.toggle.addEventListener("click", () => this.turn(!this.is_on));
    byId("help-open").addEventListener("click", () => this.help.showModal());
    addEventListener("keydown", (event) => this.press(event));
    this.turn(this.is_on);
    this.write();
  }

  /** For those who steer by voice or hold keys by mistake. @param {boolean} is_on */
  turn(is_on) {
    this.is_on = is_on;
    setText(this.toggle, is_on ? "on" : "off");
    setAttribute(this.toggle, "aria-pressed", String(is_on));
    remember(STORED, is_on ? "on" : "off");
  }

  /** @param {KeyboardEvent} event */
  press(event) {
    if (event.ctrlKey || event.altKey || event.metaKey || event.repeat || event.defaultPrevented) return;
    if (document.querySelector("dialog[open]")) return;
    if (event.target instanceof HTMLInputElement || event.target instanceof HTMLSelectElement || (event.key === " " && event.target instanceof HTMLButtonElement)) return;
    if (event.key === "?") {
      this.help.showModal();
      return;
    }
    if (!this.is_on) return;
    if (/^[1-9]$/.test(event.key)) {
      this.choose(Number(event.key));
      return;
    }
    const found = this.shortcuts.find((shortcut) => shortcut.key === event.key.toLowerCase());
    if (!found?.act) return;
    event.preventDefault();
    found.act();
  }

  write() {
    const rows = [...this.shortcuts, { key: "1 … 9", does: "Choose a payload" }, { key: "?", does: "This page" }];
    byId("help-keys").append(
      ...rows.map(({ key, does }) => {
        const keys = (key === " " ? ["space"] : key.split(" ")).map((part) => (part === "…" ? part : make("kbd", "", part.length === 1 ? part.toUpperCase() : part)));
        return make("div", "", make("dt", "", ...keys), make("dd", "", does));
      }),
    );
    byId("help-symbols").append(
      ...["TRACKING", "DEGRADED", "LOST", "INITIALIZING", "GONE"].map((state) => {
        const look = lookOf(state);
        const row = make("div", "", make("dt", "", icon(look.icon)), make("dd", "", `${look.word}: ${look.meaning.toLowerCase()}`));
        row.dataset.state = look.key;
        return row;
      }),
    );
  }
}
