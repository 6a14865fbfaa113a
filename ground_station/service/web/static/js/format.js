// @ts-check
/** Numbers, units and times as text. What is unknown is a dash, never a zero. */

export const UNKNOWN = "–";
const MINUS = "−";

/** @param {number|null|undefined} value @param {number} [digits] */
export function number(value, digits = 0) {
  if (value == null || !Number.isFinite(value)) return UNKNOWN;
  const text = value.toFixed(digits);
  if (!text.startsWith("-")) return text;
  return Number(text) === 0 ? text.slice(1) : MINUS + text.slice(1);
}

/** Counts with a narrow gap between thousands. @param {number|null|undefined} value */
export function count(value) {
  if (value == null || !Number.isFinite(value)) return UNKNOWN;
  return Math.round(value).toString().replace(/\B(?=(\d{3})+$)/g, "\u202f");
}

/** @param {number|null|undefined} share 0 to 1 @param {number} [digits] */
export function percent(share, digits = 0) {
  return share == null || !Number.isFinite(share) ? UNKNOWN : `${number(100 * share, digits)} %`;
}

/** @param {number} seconds */
export function duration(seconds) {
  if (!Number.isFinite(seconds)) return UNKNOWN;
  const s = Math.max(0, Math.floor(seconds));
  if (s < 60) return `${s} s`;
  if (s < 3600) return `${Math.floor(s / 60)} min ${String(s % 60).padStart(2, "0")} s`;
  if (s < 86400) return `${Math.floor(s / 3600)} h ${String(Math.floor((s % 3600) / 60)).padStart(2, "0")} min`;
  return `${Math.floor(s / 86400)} d ${Math.floor((s % 86400) / 3600)} h`;
}

/** As on a stop watch. @param {number} seconds */
export function stopwatch(seconds) {
  if (!Number.isFinite(seconds)) return UNKNOWN;
  const s = Math.max(0, Math.floor(seconds));
  const parts = [Math.floor(s / 3600), Math.floor((s % 3600) / 60), s % 60];
  if (!parts[0]) parts.shift();
  return parts.map((part, k) => (k ? String(part).padStart(2, "0") : String(part))).join(":");
}

/** @param {number|null|undefined} megabytes */
export function size(megabytes) {
  if (megabytes == null || !Number.isFinite(megabytes)) return UNKNOWN;
  return megabytes >= 1000 ? `${number(megabytes / 1000, 1)} GB` : `${number(megabytes, megabytes < 10 ? 1 : 0)} MB`;
}

const CLOCK = new Intl.DateTimeFormat(undefined, { hour: "2-digit", minute: "2-digit", second: "2-digit", hourCycle: "h23" });
const DAY = new Intl.DateTimeFormat(undefined, { dateStyle: "medium", timeStyle: "long" });

/** Local time of the day. @param {number} ms since 1970 */
export function clockTime(ms) {
  return Number.isFinite(ms) ? CLOCK.format(ms) : UNKNOWN;
}

/** Local date and time. @param {number} ms since 1970 */
export function dateTime(ms) {
  return Number.isFinite(ms) ? DAY.format(ms) : UNKNOWN;
}
