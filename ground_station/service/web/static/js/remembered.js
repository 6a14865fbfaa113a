// @ts-check
/** What this browser remembers of choices; one that keeps nothing asks again next time. */

/** @param {string} name @returns {string} empty where nothing was kept */
export function recall(name) {
  try {
    return localStorage.getItem(name) ?? "";
  } catch {
    return "";
  }
}

/** @param {string} name @param {string} value */
export function remember(name, value) {
  try {
    localStorage.setItem(name, value);
  } catch {
    // It is as it was at the next visit.
  }
}
