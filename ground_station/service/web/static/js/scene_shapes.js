// @ts-check
/** The scene's shapes as vertices for `webgl.Shape`: x, y, z, red, green, blue, alpha. */
import { rotate } from "./mat4.js";
import { lookOf, TRAIL_KEYS } from "./states.js";
import { PER_SIDE } from "./view_rays.js";

const FRUSTUM_M = 1.2;

/** @param {Float32Array} xyz @param {{min: number[], max: number[]}} bounds @param {import("./theme.js").Theme} theme */
export function landmarkPoints(xyz, bounds, theme) {
  const low = theme.rgb("landmark");
  const high = theme.rgb("accent");
  const height_m = Math.max(0.5, bounds.max[2] - bounds.min[2]);
  const out = new Float32Array((xyz.length / 3) * 7);
  for (let k = 0, at = 0; k < xyz.length; k += 3, at += 7) {
    const t = Math.min(1, Math.max(0, (xyz[k + 2] - bounds.min[2]) / height_m));
    out.set([xyz[k], xyz[k + 1], xyz[k + 2]], at);
    for (let channel = 0; channel < 3; channel += 1) out[at + 3 + channel] = low[channel] + (high[channel] - low[channel]) * t;
    out[at + 6] = 0.85;
  }
  return out;
}

/** @param {import("./trail.js").Trail} trail @param {import("./theme.js").Theme} theme */
export function trailLines(trail, theme) {
  const colours = TRAIL_KEYS.map((name) => theme.rgb(name));
  /** @type {number[]} */
  const out = [];
  for (let k = 1; k < trail.length; k += 1) {
    if (trail.gaps[k]) continue;
    const [r, g, b] = colours[trail.states[k]];
    for (const at of [3 * k - 3, 3 * k]) out.push(trail.xyz[at], trail.xyz[at + 1], trail.xyz[at + 2], r, g, b, 1);
  }
  return new Float32Array(out);
}

/**
 * The camera's view as a pyramid, its plumb line to the floor and the place below.
 * @param {import("./types.js").Estimate} estimate @param {number[][]} rays of `viewRays` @param {string} state
 * @param {import("./theme.js").Theme} theme @param {number} floor_m
 * @returns {{faces: Float32Array, lines: Float32Array}}
 */
export function frustum(estimate, rays, state, theme, floor_m) {
  const eye = estimate.position_m;
  const turn = estimate.quaternion_xyzw;
  if (!eye || !turn) return { faces: new Float32Array(), lines: new Float32Array() };
  const colour = theme.rgb(lookOf(state).key);
  const ink = theme.rgb("ink");
  const border = rays.map(([x, y]) => {
    const ray = rotate(turn, [x * FRUSTUM_M, y * FRUSTUM_M, FRUSTUM_M]);
    return ray.map((value, axis) => eye[axis] + value);
  });
  /** @type {number[]} */
  const faces = [];
  /** @type {number[]} */
  const lines = [];
  /** @param {number[]} to @param {number[][]} points @param {number[]} rgb @param {number} alpha */
  const add = (to, points, rgb, alpha) => points.forEach((p) => to.push(p[0], p[1], p[2], rgb[0], rgb[1], rgb[2], alpha));
  border.forEach((point, k) => {
    const next = border[(k + 1) % border.length];
    add(faces, [eye, point, next], colour, k < PER_SIDE ? 0.55 : 0.28); // the upper side is marked
    add(lines, k % PER_SIDE === 0 ? [eye, point, point, next] : [point, next], ink, 1);
  });
  const foot = [eye[0], eye[1], floor_m];
  add(lines, [eye, foot], ink, 0.5);
  const around = Array.from({ length: 17 }, (_, k) => {
    const angle = (2 * Math.PI * k) / 16;
    return [foot[0] + 0.25 * Math.cos(angle), foot[1] + 0.25 * Math.sin(angle), floor_m];
  });
  for (let k = 1; k < around.length; k += 1) add(lines, [around[k - 1], around[k]], ink, 0.7);
  return { faces: new Float32Array(faces), lines: new Float32Array(lines) };
}

/** Metre lines under a map without a plan. @param {{min: number[], max: number[]}} bounds @param {import("./theme.js").Theme} theme */
export function floorGrid(bounds, theme) {
  const [r, g, b] = theme.rgb("line");
  /** @type {number[]} */
  const out = [];
  const [x0, y0] = bounds.min.map(Math.floor);
  const [x1, y1] = bounds.max.map(Math.ceil);
  const step = Math.max(1, Math.ceil(Math.max(x1 - x0, y1 - y0) / 60));
  const z = bounds.min[2];
  for (let x = x0; x <= x1; x += step) out.push(x, y0, z, r, g, b, 0.8, x, y1, z, r, g, b, 0.8);
  for (let y = y0; y <= y1; y += step) out.push(x0, y, z, r, g, b, 0.8, x1, y, z, r, g, b, 0.8);
  return new Float32Array(out);
}
