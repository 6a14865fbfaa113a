// @ts-check
/** The colours of style.css for canvases, read again when the system changes to dark or light. */

const NAMES = [
  "ground", "surface", "line", "ink", "ink-soft", "accent", "tracking", "degraded", "lost",
  "initializing", "gone", "none", "plan-free", "plan-wall", "landmark", "scene", "halo",
];

export class Theme {
  /** @param {() => void} changed */
  constructor(changed) {
    /** @type {Record<string, string>} */
    this.colours = {};
    this.read();
    for (const query of ["(prefers-color-scheme: dark)", "(prefers-contrast: more)"]) {
      matchMedia(query).addEventListener("change", () => {
        this.read();
        changed();
      });
    }
  }

  read() {
    const style = getComputedStyle(document.documentElement);
    for (const name of NAMES) this.colours[name] = style.getPropertyValue(`--${name}`).trim();
  }

  /** @param {string} name @returns {string} */
  colour(name) {
    return this.colours[name] || "#888888";
  }

  /** @param {string} name @returns {[number, number, number]} 0 to 1 */
  rgb(name) {
    return parseHex(this.colour(name));
  }
}

/** @param {string} text #rrggbb @returns {[number, number, number]} 0 to 1 */
export function parseHex(text) {
  const value = Number.parseInt(text.slice(1, 7), 16);
  if (!Number.isFinite(value)) return [0.5, 0.5, 0.5];
  return [(value >> 16) / 255, ((value >> 8) & 255) / 255, (value & 255) / 255];
}
