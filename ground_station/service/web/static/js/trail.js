// @ts-check
import { trailKey } from "./states.js";

const KEPT = 3000;
const DROPPED_AT_ONCE = 300;
const LEAST_STEP_M = 0.03;
const LEAST_TIME_NS = 1e9;
const GAP_M = 2;

/** Where a payload has been: positions (m), and the state in each. */
export class Trail {
  constructor() {
    /** x, y, z by turns. @type {number[]} */
    this.xyz = [];
    /** An index of `TRAIL_KEYS` for each. @type {number[]} */
    this.states = [];
    /** Whether the way from the one before is not known. @type {boolean[]} */
    this.gaps = [];
    this.time_ns = 0;
    /** Counts changes, so that who copied it knows when to copy again. */
    this.version = 0;
  }

  get length() {
    return this.states.length;
  }

  /** @param {number[]} position_m @param {string} state @param {number} time_ns */
  add(position_m, state, time_ns) {
    const [x, y, z] = position_m;
    const key = trailKey(state);
    const at = this.xyz.length - 3;
    if (at >= 0) {
      const step_m = Math.hypot(x - this.xyz[at], y - this.xyz[at + 1], z - this.xyz[at + 2]);
      const same = key === this.states[this.states.length - 1];
      if (same && step_m < LEAST_STEP_M && time_ns - this.time_ns < LEAST_TIME_NS) return;
      if (same && step_m < LEAST_STEP_M / 10) return;
    }
    this.push(x, y, z, key);
    this.time_ns = time_ns;
    if (this.length > KEPT) {
      this.xyz.splice(0, 3 * DROPPED_AT_ONCE);
      this.states.splice(0, DROPPED_AT_ONCE);
      this.gaps.splice(0, DROPPED_AT_ONCE);
    }
    this.version += 1;
  }

  /** Takes the station's own trail, whose states are not known. @param {number[][]} positions_m @param {number[]} breaks */
  replace(positions_m, breaks) {
    if (this.length > positions_m.length) return; // ours is longer and has the states
    const begins = new Set(breaks);
    const first = Math.max(0, positions_m.length - KEPT);
    this.xyz = [];
    this.states = [];
    this.gaps = [];
    for (let k = first; k < positions_m.length; k += 1) {
      const [x, y, z] = positions_m[k];
      this.push(x, y, z, trailKey(""));
      if (begins.has(k)) this.gaps[this.gaps.length - 1] = true;
    }
    this.version += 1;
  }

  /** @param {number} x @param {number} y @param {number} z @param {number} key */
  push(x, y, z, key) {
    const at = this.xyz.length - 3;
    this.gaps.push(at < 0 || Math.hypot(x - this.xyz[at], y - this.xyz[at + 1], z - this.xyz[at + 2]) > GAP_M);
    this.xyz.push(x, y, z);
    this.states.push(key);
  }
}
