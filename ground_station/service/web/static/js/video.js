// @ts-check
/** Live pictures, with the landmarks of just that frame drawn above. */
import { byId, canvasById, fitCanvas, setAttribute, setText, show, watchBox } from "./dom.js";
import { number } from "./format.js";

const TELL_MS = 200;
const FAINT_FRAMES = 4;

export class Video {
  /** @param {import("./store.js").Store} store @param {import("./loop.js").Loop} loop @param {import("./theme.js").Theme} theme @param {(message: Record<string, any>) => void} send */
  constructor(store, loop, theme, send) {
    this.store = store;
    this.loop = loop;
    this.theme = theme;
    this.send = send;
    this.canvas = canvasById("video-picture");
    this.overlay = canvasById("video-points");
    this.empty = byId("video-empty");
    this.caption = byId("video-caption");
    this.box = watchBox(this.overlay, () => loop.mark("video-points"));
    this.is_on = true;
    /** The newest that came while one was being decoded. @type {{header: any, jpeg: Uint8Array<ArrayBuffer>}|null} */
    this.waiting = null;
    this.is_decoding = false;
    /** Decoded, not drawn. @type {{header: any, bitmap: ImageBitmap}|null} */
    this.ready = null;
    /** @type {import("./types.js").VideoHeader|null} */
    this.shown = null;
    this.shown_at_ms = 0;
    this.told_ms = 0;
    /** Capture to screen of the newest picture, ms; NaN where the payload's clock is unknown. */
    this.latency_ms = NaN;
    byId("video-toggle").addEventListener("click", () => this.turn(!this.is_on));
    document.addEventListener("visibilitychange", () => this.ask());
    loop.add(["video"], () => this.draw());
    loop.add(["video", "video-points", "estimate", "theme"], () => this.drawPoints());
    loop.add(["tick", "selection", "video"], () => this.drawState(), 250);
  }

  /** @param {boolean} is_on */
  turn(is_on) {
    this.is_on = is_on;
    setAttribute(byId("video-toggle"), "aria-pressed", String(is_on));
    setText(byId("video-toggle"), is_on ? "On" : "Off");
    if (!is_on) this.clear();
    this.ask();
    this.loop.mark("video");
  }

  /** Says whether pictures are wanted: not while nobody can see them. */
  ask() {
    this.send({ type: "video", on: this.is_on && !document.hidden });
  }

  clear() {
    this.waiting = null;
    this.ready?.bitmap.close();
    this.ready = null;
    this.shown = null;
    this.latency_ms = NaN;
    this.canvas.getContext("2d")?.clearRect(0, 0, this.canvas.width, this.canvas.height);
    this.loop.mark("video-points");
    this.loop.mark("tick");
  }

  /** @param {import("./types.js").VideoHeader} header @param {Uint8Array<ArrayBuffer>} jpeg */
  take(header, jpeg) {
    if (!this.is_on || document.hidden || header.payload !== this.store.selected) return;
    this.waiting = { header, jpeg };
    if (!this.is_decoding) this.decode();
  }

  async decode() {
    this.is_decoding = true;
    while (this.waiting) {
      const { header, jpeg } = this.waiting;
      this.waiting = null;
      try {
        const bitmap = await createImageBitmap(new Blob([jpeg], { type: "image/jpeg" }));
        this.ready?.bitmap.close(); // the screen is slower than the pictures
        this.ready = { header, bitmap };
        this.loop.mark("video");
      } catch {
        // A broken picture: the next one comes soon.
      }
    }
    this.is_decoding = false;
  }

  draw() {
    if (!this.ready) return;
    const { header, bitmap } = this.ready;
    this.ready = null;
    if (header.payload === this.store.selected && this.is_on) {
      if (this.canvas.width !== bitmap.width || this.canvas.height !== bitmap.height) {
        this.canvas.width = bitmap.width;
        this.canvas.height = bitmap.height;
      }
      this.canvas.getContext("2d", { alpha: false })?.drawImage(bitmap, 0, 0);
      this.shown = header;
      this.shown_at_ms = performance.now();
      this.tell(header);
    }
    bitmap.close();
  }

  /** @param {import("./types.js").VideoHeader} header */
  tell(header) {
    this.latency_ms = header.capture_ns == null ? NaN : this.store.clock.now_ms() - header.capture_ns / 1e6;
    if (!Number.isFinite(this.latency_ms) || this.shown_at_ms - this.told_ms < TELL_MS) return;
    this.told_ms = this.shown_at_ms;
    this.send({ type: "shown", sequence: header.sequence, shown_ms: this.latency_ms });
  }

  /**
   * The landmarks of just the shown frame; where the localizer left that one out, those of one
   * shortly before, faintly.
   * @returns {{points: number[], is_exact: boolean}|null}
   */
  points() {
    const known = this.store.current?.points;
    if (!this.shown || !known) return null;
    for (let back = 0; back <= FAINT_FRAMES; back += 1) {
      const points = known.get(this.shown.sequence - back);
      if (points) return { points, is_exact: back === 0 };
    }
    return null;
  }

  drawPoints() {
    const c = this.overlay.getContext("2d");
    if (!c) return;
    const ratio = fitCanvas(this.overlay, this.box);
    c.setTransform(1, 0, 0, 1, 0, 0);
    c.clearRect(0, 0, this.overlay.width, this.overlay.height);
    const found = this.points();
    if (!this.shown || !found) return;
    // The picture lies in the middle of the box, as `object-fit: contain` puts it.
    const scale = Math.min(this.box.width / this.shown.width_px, this.box.height / this.shown.height_px) * ratio;
    const x0 = (this.overlay.width - this.shown.width_px * scale) / 2;
    const y0 = (this.overlay.height - this.shown.height_px * scale) / 2;
    c.globalAlpha = found.is_exact ? 1 : 0.4;
    for (const [size, colour] of /** @type {[number, string][]} */ ([[4.2, "#000000"], [2.8, "#f0e442"]])) {
      c.beginPath();
      for (let k = 0; k + 1 < found.points.length; k += 2) {
        // Pixel (0, 0) is the centre of the first one.
        const x = x0 + (found.points[k] + 0.5) * scale;
        const y = y0 + (found.points[k + 1] + 0.5) * scale;
        c.rect(x - (size * ratio) / 2, y - (size * ratio) / 2, size * ratio, size * ratio);
      }
      c.fillStyle = colour;
      c.fill();
    }
  }

  drawState() {
    const since_s = (performance.now() - this.shown_at_ms) / 1e3;
    const is_stale = Boolean(this.shown) && since_s > 2 && !this.store.playback;
    setAttribute(this.canvas, "data-stale", is_stale ? "true" : null);
    setAttribute(this.overlay, "data-stale", is_stale ? "true" : null);
    show(this.empty, !this.shown || is_stale);
    const text = !this.is_on
      ? "Video is off"
      : !this.shown
        ? "No picture yet"
        : `No picture for ${number(since_s, 0)} s`;
    if (!this.empty.hidden) setText(this.empty, text);
    const found = this.points();
    const tracked = found ? `${found.points.length / 2} landmarks` : "";
    setText(this.caption, this.shown ? `frame ${this.shown.sequence}${tracked ? ` · ${tracked}` : ""}` : "");
  }
}
