// @ts-check
/** What lies on the floor plan: grid, scale, trail, ellipse and the blimps. */
import { ellipseOf } from "./ellipse.js";
import { lookOf, TRAIL_KEYS } from "./states.js";

/** @typedef {CanvasRenderingContext2D} Context */
/** @typedef {import("./view2d.js").View2d} View */
/** @typedef {import("./theme.js").Theme} Theme */

/** Lines each metre, where they are not too dense, and each fifth. @param {Context} c @param {View} view @param {Theme} theme */
export function drawGrid(c, view, theme) {
  const [left, top] = view.toWorld(0, 0);
  const [right, bottom] = view.toWorld(view.width, view.height);
  c.strokeStyle = theme.colour("line");
  c.lineWidth = 1;
  for (const [step, alpha] of [[1, 0.5], [5, 1]]) {
    if (step * view.scale < 12) continue;
    c.globalAlpha = alpha;
    c.beginPath();
    for (let x = Math.ceil(left / step) * step; x <= right; x += step) {
      const px = Math.round(view.toScreen(x, 0)[0]) + 0.5;
      c.moveTo(px, 0);
      c.lineTo(px, view.height);
    }
    for (let y = Math.ceil(bottom / step) * step; y <= top; y += step) {
      const py = Math.round(view.toScreen(0, y)[1]) + 0.5;
      c.moveTo(0, py);
      c.lineTo(view.width, py);
    }
    c.stroke();
  }
  c.globalAlpha = 1;
}

/** A bar of a round length, bottom left. @param {Context} c @param {View} view @param {Theme} theme */
export function drawScale(c, view, theme) {
  const length_m = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50].find((m) => m * view.scale >= 56) ?? 100;
  const length = length_m * view.scale;
  const [x, y] = [16.5, view.height - 16.5];
  const label = length_m < 1 ? `${length_m * 100} cm` : `${length_m} m`;
  c.font = "600 13px system-ui, sans-serif";
  c.textBaseline = "bottom";
  c.textAlign = "left";
  for (const [colour, width] of /** @type {[string, number][]} */ ([["halo", 5], ["ink", 1.5]])) {
    c.strokeStyle = theme.colour(colour);
    c.lineWidth = width;
    c.lineJoin = "round";
    if (colour === "halo") c.strokeText(label, x + 4, y - 5);
    c.beginPath();
    c.moveTo(x, y - 6);
    c.lineTo(x, y);
    c.lineTo(x + length, y);
    c.lineTo(x + length, y - 6);
    c.stroke();
  }
  c.fillStyle = theme.colour("ink");
  c.fillText(label, x + 4, y - 5);
}

/** One path for each state, so that thousands of steps cost few calls. @param {Context} c @param {View} view @param {Theme} theme @param {import("./trail.js").Trail} trail @param {boolean} faint */
export function drawTrail(c, view, theme, trail, faint = false) {
  const { xyz, states, gaps } = trail;
  c.lineCap = "round";
  c.lineJoin = "round";
  for (let key = 0; key < TRAIL_KEYS.length; key += 1) {
    c.beginPath();
    let some = false;
    for (let k = 1; k < states.length; k += 1) {
      if (states[k] !== key || gaps[k]) continue;
      const [ax, ay] = view.toScreen(xyz[3 * k - 3], xyz[3 * k - 2]);
      const [bx, by] = view.toScreen(xyz[3 * k], xyz[3 * k + 1]);
      if (!some || states[k - 1] !== key || gaps[k - 1]) c.moveTo(ax, ay);
      c.lineTo(bx, by);
      some = true;
    }
    if (!some) continue;
    const name = TRAIL_KEYS[key];
    c.setLineDash(name === "degraded" ? [6, 6] : []); // told apart without colour, too
    c.strokeStyle = theme.colour(name);
    c.globalAlpha = faint ? 0.35 : 0.9;
    c.lineWidth = faint ? 1.5 : 2.5;
    c.stroke();
  }
  c.setLineDash([]);
  c.globalAlpha = 1;
}

/** @param {Context} c @param {View} view @param {Theme} theme @param {import("./types.js").Estimate} estimate @param {string} state @param {number} sigmas */
export function drawEllipse(c, view, theme, estimate, state, sigmas) {
  const p = estimate.position_sigma_m;
  if (!p || !estimate.position_m) return;
  const ellipse = ellipseOf(p[0], p[1], p[4], sigmas);
  if (!ellipse) return;
  const [x, y] = view.toScreen(estimate.position_m[0], estimate.position_m[1]);
  const most = 4 * Math.max(view.width, view.height);
  const major = Math.min(most, Math.max(1, ellipse.major_m * view.scale));
  const minor = Math.min(most, Math.max(1, ellipse.minor_m * view.scale));
  c.beginPath();
  c.ellipse(x, y, major, minor, -ellipse.angle_rad, 0, 2 * Math.PI);
  c.fillStyle = c.strokeStyle = theme.colour(lookOf(state).key);
  c.globalAlpha = 0.22;
  c.fill();
  c.globalAlpha = 1;
  c.lineWidth = 1.5;
  c.stroke();
}

/**
 * An arrow along the view of the camera; hollow where the place is an old one.
 * @param {Context} c @param {View} view @param {Theme} theme
 * @param {import("./types.js").Estimate} estimate @param {string} state
 * @param {{label?: string, old?: boolean, size?: number}} [how]
 */
export function drawBlimp(c, view, theme, estimate, state, how = {}) {
  if (!estimate.position_m) return;
  const [x, y] = view.toScreen(estimate.position_m[0], estimate.position_m[1]);
  const r = how.size ?? 17;
  const colour = theme.colour(lookOf(state).key);
  c.save();
  c.translate(x, y);
  c.rotate((-(estimate.heading_deg ?? 90) * Math.PI) / 180);
  c.beginPath();
  if (estimate.heading_deg == null) c.arc(0, 0, r * 0.6, 0, 2 * Math.PI);
  else {
    c.moveTo(r, 0);
    c.lineTo(-r * 0.8, r * 0.68);
    c.lineTo(-r * 0.4, 0);
    c.lineTo(-r * 0.8, -r * 0.68);
  }
  c.closePath();
  c.lineJoin = "round";
  c.lineWidth = 6;
  c.strokeStyle = theme.colour("halo");
  c.stroke();
  c.fillStyle = how.old ? theme.colour("halo") : colour;
  c.fill();
  c.lineWidth = how.old ? 2.5 : 1.5;
  c.strokeStyle = how.old ? colour : theme.colour("ink");
  c.stroke();
  c.restore();
  if (!how.label) return;
  c.font = "600 14px system-ui, sans-serif";
  c.textAlign = "center";
  // The names of others stand above, what is said of this one below.
  const is_above = how.size !== undefined;
  const at = is_above ? y - r - 5 : y + r + 5;
  c.textBaseline = is_above ? "bottom" : "top";
  c.lineWidth = 4;
  c.lineJoin = "round";
  c.strokeStyle = theme.colour("halo");
  c.strokeText(how.label, x, at);
  c.fillStyle = theme.colour("ink");
  c.fillText(how.label, x, at);
}
