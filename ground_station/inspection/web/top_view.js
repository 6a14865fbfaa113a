// @ts-check
/** The map from above: floor plan, localizability, landmarks and keyframes. */
import { colourAt, css, length } from "./colours.js";
import { canvasById, fitCanvas, watchBox } from "./dom.js";
import { listen } from "./gestures.js";
import { hatching } from "./picture.js";
import { View2d } from "./view2d.js";

const LOST = "#b33c00";
const LOST_GROUND = "rgba(255,214,188,0.9)";
const LEAST_ROSE_PX = 14;
const BREAK = 6; // steps this many times the usual one are no way

export class TopView {
  /**
   * @param {any} meta @param {(name: string) => Float32Array|Int32Array} array
   * @param {import("./layer.js").Layer} layer @param {import("./theme.js").Theme} theme
   */
  constructor(meta, array, layer, theme) {
    this.meta = meta;
    this.layer = layer;
    this.theme = theme;
    this.points = array("point");
    this.place = array("camera-place");
    this.turn = array("camera-heading");
    this.name = "sigma";
    this.choice = "worst";
    this.shows = { layer: true, landmarks: true, keyframes: true };
    this.is_fitted = true;
    this.asked = false;
    /** @type {HTMLCanvasElement|null} */
    this.plan = null;
    /** @type {(x: number|null, y: number|null, place: number) => void} */
    this.pointed = () => {};
    this.view = new View2d();
    this.canvas = canvasById("top");
    this.box = watchBox(this.canvas, () => this.resized());
    const pan = (/** @type {number} */ dx, /** @type {number} */ dy) => this.move(() => this.view.pan(dx, dy));
    listen(this.canvas, {
      drag: pan,
      shift: pan,
      zoom: (factor, x, y) => this.move(() => this.view.zoom(factor, x, y)),
      reset: () => this.fit(),
      hover: (x, y) => this.point(x, y),
      leave: () => this.pointed(null, null, -1),
    });
    // A finger does not hover: it points where it taps.
    this.canvas.addEventListener("click", (event) => this.point(event.offsetX, event.offsetY));
  }

  /** @param {number} x_px @param {number} y_px */
  point(x_px, y_px) {
    const [x, y] = this.view.toWorld(x_px, y_px);
    this.pointed(x, y, this.layer.placeAt(x, y));
  }

  resized() {
    this.view.width = this.box.width;
    this.view.height = this.box.height;
    if (this.view.is_fitted) this.view.fit(this.meta.area, 24);
    this.ask();
  }

  fit() {
    this.view.is_fitted = true;
    this.resized();
  }

  /** @param {() => void} act */
  move(act) {
    act();
    this.ask();
  }

  ask() {
    if (this.asked) return;
    this.asked = true;
    requestAnimationFrame(() => this.draw());
  }

  draw() {
    this.asked = false;
    const c = this.canvas.getContext("2d");
    if (!c) return;
    const ratio = fitCanvas(this.canvas, this.box);
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.fillStyle = this.theme.colour("surface");
    c.fillRect(0, 0, this.view.width, this.view.height);
    if (this.plan) this.drawPlan(c, this.plan);
    if (this.shows.layer) this.drawLayer(c);
    if (this.shows.landmarks) this.drawLandmarks(c);
    if (this.shows.keyframes) this.drawKeyframes(c);
    this.drawScale(c);
  }

  /** @param {CanvasRenderingContext2D} c @param {HTMLCanvasElement} picture */
  drawPlan(c, picture) {
    const { origin, width } = this.meta.plan;
    const [x, y] = this.view.toScreen(origin[0], origin[1]);
    const scale = (this.view.scale * width) / picture.width;
    c.save();
    c.translate(x, y);
    c.rotate(-origin[2]);
    c.scale(scale, scale);
    c.drawImage(picture, 0, -picture.height);
    c.restore();
  }

  /** @param {CanvasRenderingContext2D} c */
  drawLayer(c) {
    const { layer, view, meta } = this;
    const { origin, cell } = layer.grid;
    const hatch = hatching(c, LOST, LOST_GROUND);
    const side = cell * view.scale;
    c.globalAlpha = 0.85;
    for (let k = 0; k < layer.places; k += 1) {
      const [x, y] = view.toScreen(origin[0] + layer.cells[2 * k] * cell, origin[1] + (layer.cells[2 * k + 1] + 1) * cell);
      if (x > view.width || y > view.height || x + side < 0 || y + side < 0) continue;
      if (this.choice === "rose" && side >= LEAST_ROSE_PX) {
        this.drawRose(c, k, x + side / 2, y + side / 2, 0.47 * side, hatch);
        continue;
      }
      const shown = layer.cell(this.name, k, this.choice === "rose" ? "worst" : this.choice);
      c.fillStyle = shown.lost || !Number.isFinite(shown.value) ? hatch : css(colourAt(meta.ramp, layer.goodness(this.name, shown.value)));
      c.fillRect(x + 0.5, y + 0.5, Math.max(side - 1, 1), Math.max(side - 1, 1));
    }
    c.globalAlpha = 1;
  }

  /** Every heading of a place, each as the sector it looks into. @param {CanvasRenderingContext2D} c @param {number} place @param {number} x @param {number} y @param {number} radius @param {CanvasPattern} hatch */
  drawRose(c, place, x, y, radius, hatch) {
    const { layer, meta } = this;
    const half = Math.PI / layer.headings;
    for (let h = 0; h < layer.headings; h += 1) {
      const shown = layer.cell(this.name, place, String(h));
      const middle = (-layer.grid.heading_deg[h] * Math.PI) / 180;
      c.beginPath();
      c.moveTo(x, y);
      c.arc(x, y, radius, middle - 0.94 * half, middle + 0.94 * half);
      c.closePath();
      c.fillStyle = shown.lost ? hatch : css(colourAt(meta.ramp, layer.goodness(this.name, shown.value)));
      c.fill();
    }
  }

  /** @param {CanvasRenderingContext2D} c */
  drawLandmarks(c) {
    c.fillStyle = this.theme.colour("ink");
    c.globalAlpha = 0.45;
    for (let k = 0; k < this.points.length; k += 3) {
      const [x, y] = this.view.toScreen(this.points[k], this.points[k + 1]);
      c.fillRect(x - 0.6, y - 0.6, 1.2, 1.2);
    }
    c.globalAlpha = 1;
  }

  /** The way of the keyframes in their order, with ticks where they look. @param {CanvasRenderingContext2D} c */
  drawKeyframes(c) {
    const { place, turn, view, theme } = this;
    const count = place.length / 3;
    if (!count) return;
    const at = Array.from({ length: count }, (_, k) => view.toScreen(place[3 * k], place[3 * k + 1]));
    const steps = at.slice(1).map((p, k) => Math.hypot(p[0] - at[k][0], p[1] - at[k][1]));
    const usual = [...steps].sort((a, b) => a - b)[steps.length >> 1] ?? 0;
    for (const [colour, width] of /** @type {[string, number][]} */ ([["halo", 5], ["accent", 2]])) {
      c.strokeStyle = theme.colour(colour);
      c.lineWidth = width;
      c.lineJoin = c.lineCap = "round";
      c.beginPath();
      at.forEach(([x, y], k) => (k && steps[k - 1] <= BREAK * usual ? c.lineTo(x, y) : c.moveTo(x, y)));
      at.forEach(([x, y], k) => {
        c.moveTo(x, y);
        c.lineTo(x + 7 * Math.cos(turn[k]), y - 7 * Math.sin(turn[k]));
      });
      c.stroke();
    }
    this.label(c, at[0], "first");
    if (count > 1) this.label(c, at[count - 1], "last");
  }

  /** @param {CanvasRenderingContext2D} c @param {number[]} at @param {string} words */
  label(c, at, words) {
    const { theme } = this;
    c.font = "600 12px system-ui, sans-serif";
    c.textBaseline = "middle";
    const side = words === "first" ? -9 : 9; // a walk may end where it began
    c.textAlign = side < 0 ? "right" : "left";
    c.lineJoin = "round";
    c.beginPath();
    c.arc(at[0], at[1], 5, 0, 2 * Math.PI);
    c.fillStyle = theme.colour("accent");
    c.strokeStyle = theme.colour("halo");
    c.lineWidth = 2;
    c.fill();
    c.stroke();
    c.lineWidth = 4;
    c.strokeText(words, at[0] + side, at[1]);
    c.fillStyle = theme.colour("ink");
    c.fillText(words, at[0] + side, at[1]);
  }

  /** A bar of a round length, bottom left. @param {CanvasRenderingContext2D} c */
  drawScale(c) {
    const { view, theme, meta } = this;
    const per_unit = view.scale * meta.scale; // screen pixels of one of the map's units
    const power = 10 ** Math.floor(Math.log10(120 / per_unit));
    const bar = [5, 2, 1].map((n) => n * power).find((n) => n * per_unit <= 120) ?? power;
    const [x, y, end] = [16.5, view.height - 14.5, 16.5 + bar * per_unit];
    const words = length(bar, meta.units).replace(/\.0+(?= )/, "");
    c.font = "600 13px system-ui, sans-serif";
    c.textBaseline = "bottom";
    c.textAlign = "left";
    c.lineJoin = "round";
    for (const [colour, width] of /** @type {[string, number][]} */ ([["halo", 5], ["ink", 1.5]])) {
      c.strokeStyle = theme.colour(colour);
      c.lineWidth = width;
      if (colour === "halo") c.strokeText(words, x + 4, y - 5);
      c.beginPath();
      c.moveTo(x, y - 6);
      c.lineTo(x, y);
      c.lineTo(end, y);
      c.lineTo(end, y - 6);
      c.stroke();
    }
    c.fillStyle = theme.colour("ink");
    c.fillText(words, x + 4, y - 5);
  }
}
