// @ts-check
/** Values as colours: a ramp that people of every colour vision read the same way, and its words. */

/** @param {number[][]} ramp colours, 0 to 1, evenly spaced @param {number} t 0 to 1 @returns {number[]} */
export function colourAt(ramp, t) {
  const place = Math.min(1, Math.max(0, Number.isFinite(t) ? t : 0)) * (ramp.length - 1);
  const k = Math.min(ramp.length - 2, Math.floor(place));
  return ramp[k].map((value, channel) => value + (ramp[k + 1][channel] - value) * (place - k));
}

/** @param {number[]} rgb 0 to 1 */
export const css = (rgb) => `rgb(${rgb.map((value) => Math.round(255 * value)).join(",")})`;

/** A scale from values to 0 … 1: from their 2nd to their 98th percentile, by ratio where all are positive. */
export class Scale {
  /** @param {ArrayLike<number>} values @param {boolean} by_ratio */
  constructor(values, by_ratio) {
    const known = Float32Array.from(values).filter((value) => Number.isFinite(value) && (!by_ratio || value > 0)).sort();
    const at = (/** @type {number} */ share) => known[Math.round(share * (known.length - 1))] ?? 1;
    this.by_ratio = by_ratio;
    this.low = at(0.02);
    this.high = Math.max(at(0.98), by_ratio ? this.low * 1.001 : this.low + 1e-9);
  }

  /** @param {number} value @returns {number} 0 to 1, and beyond */
  share(value) {
    if (!this.by_ratio) return (value - this.low) / (this.high - this.low);
    return Math.log(Math.max(value, 1e-12) / this.low) / Math.log(this.high / this.low);
  }
}

/** Three digits that matter. @param {number} value */
export function digits(value) {
  if (!Number.isFinite(value)) return "–";
  const places = Math.max(0, Math.min(6, 2 - Math.floor(Math.log10(Math.max(Math.abs(value), 1e-9)))));
  return value.toFixed(places);
}

/** A length in the map's units. @param {number} value @param {string} units "m", or anything where it is arbitrary */
export function length(value, units) {
  if (!Number.isFinite(value)) return "–";
  if (units !== "m") return `${digits(value)} units`;
  if (value < 0.01) return `${digits(1000 * value)} mm`;
  return value < 1 ? `${digits(100 * value)} cm` : `${digits(value)} m`;
}

/**
 * Draws a ramp into a canvas and says its ends.
 * @param {HTMLCanvasElement} canvas @param {number[][]} ramp @param {boolean} is_reversed
 */
export function drawRamp(canvas, ramp, is_reversed) {
  const c = canvas.getContext("2d");
  if (!c) return;
  for (let x = 0; x < canvas.width; x += 1) {
    const t = x / (canvas.width - 1);
    c.fillStyle = css(colourAt(ramp, is_reversed ? 1 - t : t));
    c.fillRect(x, 0, 1, canvas.height);
  }
}
