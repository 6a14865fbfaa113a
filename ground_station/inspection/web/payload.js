// @ts-check
/** What the page was given: figures as JSON, arrays as base64. */

/** @param {string} id @returns {any} */
export function json(id) {
  return JSON.parse(document.getElementById(id)?.textContent || "null");
}

/** @param {string} name @returns {Float32Array|Int32Array} empty where the page has no such array */
export function array(name) {
  const node = document.getElementById(`data-${name}`);
  const text = atob((node?.textContent || "").trim());
  const bytes = new Uint8Array(text.length);
  for (let k = 0; k < bytes.length; k += 1) bytes[k] = text.charCodeAt(k);
  return node?.dataset.kind === "int32" ? new Int32Array(bytes.buffer) : new Float32Array(bytes.buffer);
}
