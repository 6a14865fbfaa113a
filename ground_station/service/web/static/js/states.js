// @ts-check
/**
 * How a state looks: a word, a shape and a colour (Okabe and Ito's palette, told apart with any
 * colour vision), so that none of them says it alone.
 */

/**
 * @typedef {object} Look
 * @property {string} key the value of `data-state`, which style.css colours by
 * @property {string} word
 * @property {string} icon of the page's sprite
 * @property {string} meaning where the station gives no reason
 */

/** @type {Record<string, Look>} */
const LOOKS = {
  TRACKING: { key: "tracking", word: "Tracking", icon: "tracking", meaning: "Position known" },
  DEGRADED: { key: "degraded", word: "Degraded", icon: "degraded", meaning: "Position known, but weakly" },
  LOST: { key: "lost", word: "Lost", icon: "lost", meaning: "Position unknown" },
  INITIALIZING: { key: "initializing", word: "Initializing", icon: "initializing", meaning: "Looking for the first position" },
  GONE: { key: "gone", word: "Gone", icon: "gone", meaning: "Nothing is heard of this payload" },
  OFFLINE: { key: "gone", word: "Offline", icon: "gone", meaning: "The station is not connected; what is shown is old" },
  STALE: { key: "gone", word: "No estimate", icon: "gone", meaning: "No estimate comes any more" },
  WAITING: { key: "none", word: "Waiting", icon: "none", meaning: "No estimate yet" },
  NONE: { key: "none", word: "No payload", icon: "none", meaning: "No payload has been heard yet" },
};

/** @param {string} state @returns {Look} also for a state of a newer station */
export function lookOf(state) {
  return LOOKS[state] ?? { key: "none", word: state || "Unknown", icon: "none", meaning: "" };
}

/** Where a trail keeps states, it keeps these numbers. */
export const TRAIL_KEYS = ["tracking", "degraded", "lost", "initializing", "none"];

/** @param {string} state @returns {number} */
export function trailKey(state) {
  const found = TRAIL_KEYS.indexOf(lookOf(state).key);
  return found < 0 ? TRAIL_KEYS.length - 1 : found;
}
