// @ts-check
const LEAST_SCALE = 2;
const MOST_SCALE = 600;

/** World metres to CSS pixels of a view from above: x to the right, y up. */
export class View2d {
  constructor() {
    /** CSS pixels in a metre. */
    this.scale = 30;
    this.x_m = 0;
    this.y_m = 0;
    this.width = 1;
    this.height = 1;
    /** Whether the view is still the whole map's, so that it follows a new size of the box. */
    this.is_fitted = true;
  }

  /** @param {{min: number[], max: number[]}} bounds @param {number} margin_px */
  fit(bounds, margin_px = 16) {
    const size = [bounds.max[0] - bounds.min[0], bounds.max[1] - bounds.min[1]].map((s) => Math.max(s, 1));
    const room = [this.width, this.height].map((length) => Math.max(length - 2 * margin_px, 20));
    this.scale = clamp(Math.min(room[0] / size[0], room[1] / size[1]));
    this.x_m = (bounds.min[0] + bounds.max[0]) / 2;
    this.y_m = (bounds.min[1] + bounds.max[1]) / 2;
    this.is_fitted = true;
  }

  /** @param {number} x_m @param {number} y_m @returns {[number, number]} */
  toScreen(x_m, y_m) {
    return [this.width / 2 + (x_m - this.x_m) * this.scale, this.height / 2 - (y_m - this.y_m) * this.scale];
  }

  /** @param {number} x_px @param {number} y_px @returns {[number, number]} */
  toWorld(x_px, y_px) {
    return [this.x_m + (x_px - this.width / 2) / this.scale, this.y_m - (y_px - this.height / 2) / this.scale];
  }

  /** @param {number} dx_px @param {number} dy_px */
  pan(dx_px, dy_px) {
    this.x_m -= dx_px / this.scale;
    this.y_m += dy_px / this.scale;
    this.is_fitted = false;
  }

  /** The point under (x, y) stays there. @param {number} factor @param {number} x_px @param {number} y_px */
  zoom(factor, x_px, y_px) {
    const [x_m, y_m] = this.toWorld(x_px, y_px);
    this.scale = clamp(this.scale * factor);
    this.x_m = x_m - (x_px - this.width / 2) / this.scale;
    this.y_m = y_m + (y_px - this.height / 2) / this.scale;
    this.is_fitted = false;
  }
}

/** @param {number} scale */
function clamp(scale) {
  return Math.min(MOST_SCALE, Math.max(LEAST_SCALE, scale));
}
