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
 * @param {import("./types.js").MapDetails} details @param {ImageBitmap|null} plan
 * @param {Float32Array} landmarks
 */
function boundsOf(details, plan, landmarks) {
  const min = [Infinity, Infinity, Infinity];
  const max = [-Infinity, -Infinity, -Infinity];
  /** @param {ArrayLike<number>} point */
  const include = (point) => {
    for (let axis = 0; axis < 3; axis += 1) {
      if (!Number.isFinite(point[axis])) continue;
      min[axis] = Math.min(min[axis], point[axis]);
      max[axis] = Math.max(max[axis], point[axis]);
    }
  };
  const found = details.floorplan;
  if (plan && found) {
    const [x, y, yaw] = found.origin;
    for (const [u, v] of [[0, 0], [plan.width, 0], [0, plan.height], [plan.width, plan.height]]) {
      const [a, b] = [u * found.resolution_m, v * found.resolution_m];
      include([x + a * Math.cos(yaw) - b * Math.sin(yaw), y + a * Math.sin(yaw) + b * Math.cos(yaw), 0]);
    }
  }
  for (const corner of details.bounds ? [details.bounds.min, details.bounds.max] : []) include(corner);
  if (!details.bounds) for (let k = 0; k < landmarks.length; k += 3) include(landmarks.subarray(k, k + 3));
  for (let axis = 0; axis < 3; axis += 1) {
    if (min[axis] > max[axis]) [min[axis], max[axis]] = [axis === 2 ? 0 : -5, 5];
  }
  return { min, max };
}
