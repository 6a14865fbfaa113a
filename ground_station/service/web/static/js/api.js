// @ts-check
/** The station's HTTP API. A refusal is an answer with its reason, as a broken network is. */

const LIMIT_MS = 8000;
const FETCH_MS = 600_000; // a whole map, through a radio

/**
 * @param {string} path @param {unknown} [body] goes as JSON @param {string} [method] with a body
 * @param {number} [limit_ms] @returns {Promise<Response>}
 */
function ask(path, body, method = "POST", limit_ms = LIMIT_MS) {
  const post = body === undefined ? {} : {
    method,
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify(body),
  };
  return fetch(path, { ...post, cache: "no-store", credentials: "same-origin", signal: AbortSignal.timeout(limit_ms) });
}

/** @param {Response} response @returns {Promise<string>} */
async function reasonOf(response) {
  try {
    const detail = await response.json();
    const text = detail.reason ?? detail.detail;
    if (typeof text === "string") return text;
    if (Array.isArray(text) && typeof text[0]?.msg === "string") return text[0].msg;
  } catch {
    // An answer without JSON: its status says enough.
  }
  return `the station answered ${response.status} ${response.statusText}`.trim();
}

/** @param {unknown} error @param {number} [limit_ms] @returns {string} */
function failure(error, limit_ms = LIMIT_MS) {
  if (error instanceof DOMException && error.name === "TimeoutError") return `no answer within ${limit_ms / 1000} s`;
  return "the station cannot be reached";
}

/** Whether the station wants a token that this page has not, or no more. @returns {Promise<boolean>} */
export async function isSignedOut() {
  try {
    return (await ask("/api/maps")).status === 401;
  } catch {
    return false; // it cannot be reached at all
  }
}

/** @param {string} path @returns {Promise<any>} raises an Error with one line */
export async function get(path) {
  let response;
  try {
    response = await ask(path);
  } catch (error) {
    throw new Error(failure(error));
  }
  if (!response.ok) throw new Error(await reasonOf(response));
  return response.json();
}

/** @param {string} path @returns {Promise<ArrayBuffer>} raises an Error with one line */
export async function getBytes(path) {
  const response = await ask(path);
  if (!response.ok) throw new Error(await reasonOf(response));
  return response.arrayBuffer();
}

/**
 * @param {string} path @param {unknown} body @param {string} [method] @param {number} [limit_ms]
 * @returns {Promise<import("./types.js").Answer>}
 */
export async function post(path, body, method, limit_ms) {
  try {
    const response = await ask(path, body, method, limit_ms);
    if (!response.ok) return { done: false, reason: await reasonOf(response) };
    const answer = await response.json();
    return { ...answer, done: answer.done !== false, reason: String(answer.reason ?? "") };
  } catch (error) {
    return { done: false, reason: failure(error, limit_ms) };
  }
}

const payload = (/** @type {string} */ id) => `/api/payloads/${encodeURIComponent(id)}`;

export const record = (/** @type {boolean} */ active) => post("/api/recording", { active });
export const relocalize = (/** @type {string} */ id) => post(`${payload(id)}/relocalize`, {});
export const chooseStation = (/** @type {string} */ id, /** @type {string} */ name) => post(`${payload(id)}/station`, { name });
export const chooseMap = (/** @type {string} */ id, /** @type {string} */ name) => post(`${payload(id)}/map`, { name });
export const fetchMap = (/** @type {string} */ station, /** @type {string} */ name) =>
  post(`/api/stations/${station}/maps/${encodeURIComponent(name)}`, {}, "POST", FETCH_MS);
export const command = (/** @type {string} */ id, /** @type {string} */ name, /** @type {Record<string, number>} */ values = {}) =>
  post(`${payload(id)}/command`, { name, arguments: values });
export const recordingPath = (/** @type {string} */ file, station = "") =>
  `/api/${station ? `stations/${station}/` : ""}recordings/${encodeURIComponent(file)}`;
export const deleteRecording = (/** @type {string} */ file) => post(recordingPath(file), {}, "DELETE");
export const mapPath = (/** @type {string} */ name) => `/api/maps/${encodeURIComponent(name)}`;
