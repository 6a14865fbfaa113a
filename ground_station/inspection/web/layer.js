// @ts-check
/** The localizability map: what a camera would see from each place, by heading. */
import { Scale } from "./colours.js";

/**
 * @typedef {object} Cell what is shown of one place
 * @property {number} value of the layer, NaN where unknown
 * @property {boolean} lost
 * @property {number} heading index of the heading it is of, -1: of all of them
 * @property {number} lost_headings
 */

export const LAYERS = {
  sigma: { words: "position, standard deviation", is_good_low: true },
  turn: { words: "direction, standard deviation", is_good_low: true },
  count: { words: "landmarks expected in view", is_good_low: false },
};

export class Layer {
  /** @param {any} grid of the page's figures @param {(name: string) => Float32Array|Int32Array} array */
  constructor(grid, array) {
    this.grid = grid;
    this.headings = grid.heading_deg.length;
    this.cells = array("cell");
    this.height = array("cell-height");
    /** @type {Record<string, Float32Array|Int32Array>} */
    this.values = { count: array("cell-count"), sigma: array("cell-sigma"), turn: array("cell-turn") };
    this.places = this.height.length;
    /** @type {Record<string, Scale>} */
    this.scales = {};
    for (const [name, { is_good_low }] of Object.entries(LAYERS)) {
      const all = this.values[name];
      const known = Array.from(all).filter((_, k) => !this.isLost(k));
      this.scales[name] = new Scale(known.length ? known : all, is_good_low);
    }
  }

  /** @param {number} k place times headings plus heading */
  isLost(k) {
    return this.values.count[k] < this.grid.needed;
  }

  /** From 0, bad, to 1, good. @param {string} name @param {number} value */
  goodness(name, value) {
    const share = this.scales[name].share(value);
    return LAYERS[/** @type {"sigma"} */ (name)].is_good_low ? 1 - share : share;
  }

  /** @param {string} name of the layer @param {number} place @param {string} choice worst, mean or a heading's index @returns {Cell} */
  cell(name, place, choice) {
    const first = place * this.headings;
    const values = this.values[name];
    let lost_headings = 0;
    let worst = 0;
    for (let h = 0; h < this.headings; h += 1) {
      lost_headings += this.isLost(first + h) ? 1 : 0;
      if (this.isWorse(first + h, first + worst, name)) worst = h;
    }
    if (choice === "mean") {
      let [sum, count] = [0, 0];
      for (let h = 0; h < this.headings; h += 1) {
        if (this.isLost(first + h) && name !== "count") continue;
        sum += values[first + h];
        count += 1;
      }
      return { value: count ? sum / count : NaN, lost: 2 * lost_headings > this.headings, heading: -1, lost_headings };
    }
    const heading = choice === "worst" ? worst : Number(choice);
    return { value: values[first + heading], lost: this.isLost(first + heading), heading, lost_headings };
  }

  /** A lost heading is worse than all others, and one with fewer landmarks than another lost one. @param {number} a @param {number} b @param {string} name */
  isWorse(a, b, name) {
    const { count } = this.values;
    if (this.isLost(a) !== this.isLost(b)) return this.isLost(a);
    if (this.isLost(a) || name === "count") return count[a] < count[b];
    return this.values[name][a] > this.values[name][b];
  }

  /** The place whose cell holds a point, or -1. @param {number} x @param {number} y in the page's lengths */
  placeAt(x, y) {
    const { origin, cell } = this.grid;
    const [column, row] = [Math.floor((x - origin[0]) / cell), Math.floor((y - origin[1]) / cell)];
    for (let k = 0; k < this.places; k += 1) {
      if (this.cells[2 * k] === column && this.cells[2 * k + 1] === row) return k;
    }
    return -1;
  }
}
