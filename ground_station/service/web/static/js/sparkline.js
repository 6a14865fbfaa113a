// @ts-check
import { fitCanvas, watchBox } from "./dom.js";

/** A line of a series, as high as its box: the newest number at the right, with a dot. */
export class Sparkline {
  /**
   * @param {HTMLCanvasElement} canvas @param {import("./series.js").Series} series
   * @param {import("./theme.js").Theme} theme
   * @param {{least?: number, most?: number, limit?: number}} [range] the least range of its axis, and a line to stay below
   */
  constructor(canvas, series, theme, range = {}) {
    this.canvas = canvas;
    this.series = series;
    this.theme = theme;
    this.range = range;
    this.box = watchBox(canvas, () => this.draw());
  }

  draw() {
    const c = this.canvas.getContext("2d");
    if (!c || this.box.width < 4) return;
    const ratio = fitCanvas(this.canvas, this.box);
    const { width, height } = this.box;
    const { series, theme, range } = this;
    const low = range.least ?? 0;
    const high = Math.max(range.most ?? 1, series.max() * 1.1);
    const count = series.values.length;
    const x = (/** @type {number} */ k) => 1 + ((width - 5) * k) / (count - 1);
    const y = (/** @type {number} */ v) => height - 2 - ((height - 5) * (v - low)) / (high - low || 1);
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.clearRect(0, 0, width, height);
    c.strokeStyle = theme.colour("line");
    c.lineWidth = 1;
    c.beginPath();
    c.moveTo(0, height - 0.5);
    c.lineTo(width, height - 0.5);
    c.stroke();
    if (range.limit !== undefined && range.limit < high) {
      c.setLineDash([3, 3]);
      c.strokeStyle = theme.colour("lost");
      c.beginPath();
      c.moveTo(0, y(range.limit));
      c.lineTo(width, y(range.limit));
      c.stroke();
      c.setLineDash([]);
    }
    c.beginPath();
    let is_down = false;
    for (let k = 0; k < count; k += 1) {
      const value = series.at(k);
      if (Number.isNaN(value)) is_down = false;
      else {
        if (is_down) c.lineTo(x(k), y(value));
        else c.moveTo(x(k), y(value));
        is_down = true;
      }
    }
    c.strokeStyle = theme.colour("accent");
    c.lineWidth = 1.5;
    c.lineJoin = "round";
    c.stroke();
    const newest = series.at(count - 1);
    if (Number.isNaN(newest)) return;
    c.fillStyle = theme.colour("accent");
    c.beginPath();
    c.arc(x(count - 1), y(newest), 2.5, 0, 2 * Math.PI);
    c.fill();
  }
}
