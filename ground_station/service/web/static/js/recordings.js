// @ts-check
/** The station's recordings: what there is, and what one does with a file. */
import * as api from "./api.js";
import { dialog } from "./dialogs.js";
import { byId, fields, make, setText } from "./dom.js";
import { dateTime, size, stopwatch } from "./format.js";

const SURE_MS = 4000; // a second press within deletes

export class RecordingsDialog {
  /** @param {(file: string, station: string) => void} play @param {() => string[]} stations the others that are there */
  constructor(play, stations) {
    this.play = play;
    this.stations = stations;
    this.dialog = dialog("recordings-dialog");
    this.f = fields(this.dialog);
    byId("recordings-open").addEventListener("click", () => this.open());
  }

  open() {
    if (this.dialog.open) return;
    setText(this.f.note, "Asking for the recordings…");
    this.f.list.replaceChildren();
    this.dialog.showModal();
    this.load("");
  }

  /** @param {string} said what was done before, shown above the list */
  async load(said) {
    try {
      /** @type {import("./types.js").RecordingFile[]} */
      const files = (await Promise.all([api.get("/api/recordings"), ...this.stations().map((name) => this.elsewhere(name))])).flat();
      files.sort((a, b) => b.modified_ns - a.modified_ns);
      setText(this.f.note, said || (files.length ? "Newest first." : "There are none yet: Record makes one."));
      this.f.list.replaceChildren(...files.map((file) => this.row(file)));
    } catch (error) {
      setText(this.f.note, error instanceof Error ? error.message : String(error));
    }
  }

  /** A station that does not answer has none to show. @param {string} station */
  async elsewhere(station) {
    try {
      const files = await api.get(`/api/stations/${station}/recordings`);
      return files.map((/** @type {import("./types.js").RecordingFile} */ file) => ({ ...file, station }));
    } catch {
      return [];
    }
  }

  /** @param {import("./types.js").RecordingFile} file */
  row(file) {
    const began_ms = (file.started_ns ?? file.modified_ns) / 1e6;
    const length = file.active ? "being written" : file.duration_s == null ? "cut, no index" : stopwatch(file.duration_s);
    const where = file.maps.join(", ") || (file.duration_s == null ? "" : "no map");
    const lacks = Object.entries(file.lacks ?? {}).filter(([, count]) => count);
    const without = lacks.length ? `without ${lacks.map(([why, count]) => `${count} ${why}`).join(", ")}` : "";
    const at = file.station ? `at station ${file.station}` : "";
    const after = file.after ? `goes on from ${file.after}` : "";
    const facts = [at, where, length, size(file.size_MB), without, after].filter(Boolean).join(" · ");
    const [path, name] = [api.recordingPath(file.file, file.station), make("b", "", dateTime(began_ms))];
    name.title = file.file;
    const row = make("li", "", make("div", "", name, make("small", "", facts), make("small", "", file.file)));
    const player = make("button", "", "Play");
    player.setAttribute("type", "button");
    player.addEventListener("click", () => {
      this.dialog.close();
      this.play(file.file, file.station ?? "");
    });
    if (!file.active) row.append(player);
    row.append(link("Download", path, file.file));
    if (file.station) return row;
    row.append(link("Trajectory", `${path}/trajectory.txt`, file.file.replace(/mcap$/, "txt")));
    if (!file.active) row.append(this.deleter(file.file));
    return row;
  }

  /** @param {string} file */
  deleter(file) {
    const button = make("button", "", "Delete");
    button.setAttribute("type", "button");
    button.addEventListener("click", async () => {
      if (!button.classList.contains("danger")) {
        button.classList.add("danger");
        setText(button, "Sure?");
        setTimeout(() => {
          button.classList.remove("danger");
          setText(button, "Delete");
        }, SURE_MS);
        return;
      }
      const answer = await api.deleteRecording(file);
      this.load(answer.done ? `${file} is deleted.` : `${file}: ${answer.reason}`);
    });
    return button;
  }
}

/** @param {string} text @param {string} path @param {string} file how it is saved */
function link(text, path, file) {
  const node = /** @type {HTMLAnchorElement} */ (make("a", "", text));
  node.href = path;
  node.download = file;
  return node;
}
