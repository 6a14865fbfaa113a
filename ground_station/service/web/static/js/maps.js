// @ts-check
import { get, getBytes, mapPath } from "./api.js";

/**
 * A map as the views draw it.
 * @typedef {object} LoadedMap
 * @property {string} name
 * @property {import("./types.js").MapDetails} details
 * @property {ImageBitmap|null} plan
 * @property {Float32Array} landmarks x, y, z by turns
 * @property {{min: number[], max: number[]}} bounds of landmarks and plan, metres
 */

const AGAIN_MS = 5000;
const OUTSIDE = 0.05; // of the landmarks, at each end of an axis
const MARGIN = 0.08;

/** Loads the map that the shown payload flies in; one that cannot be loaded is tried again. */
export class Maps {
  /** @param {(map: LoadedMap|null, problem: string) => void} changed */
  constructor(changed) {
    this.changed = changed;
    this.wanted = "";
    this.timer = 0;
  }

  /** @param {string} name empty: none */
  want(name) {
    if (name === this.wanted) return;
    this.wanted = name;
    clearTimeout(this.timer);
    if (name) this.load(name);
    else this.changed(null, "");
  }

  /** After the connection was gone. */
  again() {
    const name = this.wanted;
    this.wanted = "";
    this.want(name);
  }

  /** @param {string} name */
  async load(name) {
    try {
      const map = await loadMap(name);
      if (name === this.wanted) this.changed(map, "");
    } catch (error) {
      if (name !== this.wanted) return;
      this.changed(null, error instanceof Error ? error.message : String(error));
      this.timer = setTimeout(() => name === this.wanted && this.load(name), AGAIN_MS);
    }
  }
}

/** @param {string} name @returns {Promise<LoadedMap>} */
async function loadMap(name) {
  /** @type {import("./types.js").MapDetails} */
  const details = await get(mapPath(name));
  const [bytes, plan] = await Promise.all([
    getBytes(`${mapPath(name)}/landmarks`).catch(() => new ArrayBuffer(0)),
    details.floorplan ? loadPlan(`${mapPath(name)}/floorplan.png`) : null,
  ]);
  const landmarks = new Float32Array(bytes, 0, 3 * Math.floor(bytes.byteLength / 12));
  return { name, details, plan, landmarks, bounds: boundsOf(details, plan, landmarks) };
}

/** A plan that cannot be read leaves the grid. @param {string} url */
async function loadPlan(url) {
  try {
    return await createImageBitmap(new Blob([await getBytes(url)], { type: "image/png" }));
  } catch {
    return null;
  }
}

/**
 * What a view of the whole map shows: the plan, or where nearly all landmarks are. Landmarks seen
 * through a window may lie far outside.
 * @param {import("./types.js").MapDetails} details @param {ImageBitmap|null} plan
 * @param {Float32Array} landmarks
 */
function boundsOf(details, plan, landmarks) {
  const { min, max } = middle(landmarks) ?? details.bounds ?? { min: [-5, -5, 0], max: [5, 5, 3] };
  const found = details.floorplan;
  if (!plan || !found) return { min, max };
  const [x, y, yaw] = found.origin;
  const [w, h] = [plan.width * found.resolution_m, plan.height * found.resolution_m];
  const corners = [[0, 0], [w, 0], [w, h], [0, h]].map(([a, b]) => [
    x + a * Math.cos(yaw) - b * Math.sin(yaw),
    y + a * Math.sin(yaw) + b * Math.cos(yaw),
  ]);
  const [xs, ys] = [0, 1].map((axis) => corners.map((corner) => corner[axis]));
  return { min: [Math.min(...xs), Math.min(...ys), Math.min(0, min[2])], max: [Math.max(...xs), Math.max(...ys), max[2]] };
}

/** @param {Float32Array} xyz @returns {{min: number[], max: number[]}|null} what holds nearly all along each axis */
function middle(xyz) {
  if (xyz.length < 30) return null;
  const sorted = [0, 1, 2].map((axis) => xyz.filter((_, k) => k % 3 === axis).sort());
  const at = (/** @type {number} */ share) => sorted.map((values) => values[Math.floor(share * (values.length - 1))]);
  const [low, high] = [at(OUTSIDE), at(1 - OUTSIDE)];
  const margin = high.map((value, axis) => MARGIN * (value - low[axis]));
  return { min: low.map((value, axis) => value - margin[axis]), max: high.map((value, axis) => value + margin[axis]) };
}
