// @ts-check
/** The dialogs: choice of a map, and the payload's power behind its typed name. */
import * as api from "./api.js";
import { byId, fields, make, setAttribute, setText } from "./dom.js";
import { count, number } from "./format.js";

/** @param {string} id @returns {HTMLDialogElement} */
export function dialog(id) {
  const found = /** @type {HTMLDialogElement} */ (byId(id));
  // A press beside the dialog closes it.
  found.addEventListener("click", (event) => event.target === found && found.close());
  return found;
}

export class MapDialog {
  /** @param {import("./store.js").Store} store */
  constructor(store) {
    this.store = store;
    this.dialog = dialog("map-dialog");
    this.f = fields(this.dialog);
    /** @type {(name: string) => void} */
    this.chosen = () => {};
    /** @type {(station: string) => void} */
    this.sent = () => {};
  }

  async open() {
    const id = this.store.selected;
    if (!id || this.dialog.open) return;
    setText(this.f.payload, id);
    setText(this.f.note, "Asking for the maps…");
    this.f.choices.replaceChildren();
    this.dialog.showModal();
    try {
      /** @type {import("./types.js").MapSummary[]} */
      const maps = await api.get("/api/maps");
      const now = this.store.current?.estimate?.map || this.store.station.map;
      setText(this.f.note, maps.length ? "The localizer restarts in the map that is chosen." : "There are no maps. `blimp map build` makes one.");
      const shown = maps.map((map) => this.choice(map, map.name === now));
      this.f.choices.replaceChildren(...shown, ...this.offers(id), ...this.stations(id));
    } catch (error) {
      setText(this.f.note, error instanceof Error ? error.message : String(error));
    }
  }

  /** What grew from this station's map elsewhere: fetched, then chosen if that is still wanted. @param {string} id */
  offers(id) {
    return (this.store.fleet?.offers ?? []).map(({ station, map, more }) => {
      const grown = `grown by ${count(more)} landmarks`;
      const button = make("button", "choice", make("span", "", map), make("small", "", `of station ${station}`), make("small", "", grown));
      button.setAttribute("type", "button");
      button.addEventListener("click", async () => {
        setText(this.f.note, `Fetching ${map} from station ${station}…`);
        const answer = await api.fetchMap(station, map);
        if (!this.dialog.open || this.store.selected !== id) return;
        if (!answer.done) return setText(this.f.note, answer.reason);
        this.dialog.close();
        this.chosen(String(answer.values?.map));
      });
      return button;
    });
  }

  /** Where it may fly, if there is more than one station. @param {string} id */
  stations(id) {
    const others = this.store.otherStations();
    if (!others.length) return [];
    const pinned = this.store.fleet?.pins?.[id] ?? "";
    const own = this.store.station.name ?? "";
    return ["", own, ...others].map((name) => {
      const button = make("button", "choice", make("span", "", name ? `Station ${name}` : "Whichever station has room"), make("small", "", name === pinned ? "chosen" : ""));
      button.setAttribute("type", "button");
      setAttribute(button, "aria-current", name === pinned ? "true" : null);
      button.addEventListener("click", () => {
        this.dialog.close();
        this.sent(name);
      });
      return button;
    });
  }

  /** @param {import("./types.js").MapSummary} map @param {boolean} is_current */
  choice(map, is_current) {
    const [w, d] = map.extent_m ?? [];
    const facts = [`${count(map.landmarks)} landmarks`, w ? `${number(w)} × ${number(d)} m` : "", map.floorplan ? "floor plan" : "no floor plan"];
    const left = make("span", "", map.name);
    const right = make("small", "", is_current ? "in use" : map.registered ? "" : "not registered: no world coordinates");
    const button = make("button", "choice", left, right, make("small", "", facts.filter(Boolean).join(" · ")));
    button.setAttribute("type", "button");
    setAttribute(button, "aria-current", is_current ? "true" : null);
    button.addEventListener("click", () => {
      this.dialog.close();
      this.chosen(map.name);
    });
    return button;
  }
}

export class PowerDialog {
  /** @param {import("./store.js").Store} store */
  constructor(store) {
    this.store = store;
    this.dialog = dialog("power-dialog");
    this.f = fields(this.dialog);
    this.word = /** @type {HTMLInputElement} */ (byId("power-word"));
    this.id = "";
    /** @type {(id: string, command: "reboot"|"shutdown") => void} */
    this.confirmed = () => {};
    this.word.addEventListener("input", () => this.unlock());
    // Enter in the field must not close the dialog as if something had been done.
    this.word.addEventListener("keydown", (event) => event.key === "Enter" && event.preventDefault());
    for (const name of /** @type {("reboot"|"shutdown")[]} */ (["reboot", "shutdown"])) {
      byId(`power-${name}`).addEventListener("click", () => {
        if (!this.isUnlocked()) return;
        this.dialog.close();
        this.confirmed(this.id, name);
      });
    }
  }

  open() {
    this.id = this.store.selected; // stays, whatever is selected meanwhile
    if (!this.id || this.dialog.open) return;
    setText(this.f.payload, this.id);
    setText(this.f.word, this.id);
    this.word.value = "";
    this.unlock();
    this.dialog.showModal();
    this.word.focus();
  }

  isUnlocked() {
    return this.word.value.trim() === this.id;
  }

  unlock() {
    for (const name of ["reboot", "shutdown"]) {
      /** @type {HTMLButtonElement} */ (byId(`power-${name}`)).disabled = !this.isUnlocked();
    }
  }
}
