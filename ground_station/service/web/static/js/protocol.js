// @ts-check
/**
 * The live WebSocket's messages.
 *
 * Station to page, text: {"type": T, …} with T one of hello, state, estimate, event, alarm,
 * recording, gone, selected, pong. Station to page, binary: a picture (see `readVideo`). Page to station:
 * {"type": "select"|"video"|"shown"|"ping", …}.
 */

const HEADER_LIMIT = 4096;

/**
 * @param {string} text
 * @returns {Record<string, any>|null} null for what is no message
 */
export function readMessage(text) {
  try {
    const message = JSON.parse(text);
    return message && typeof message === "object" && typeof message.type === "string" ? message : null;
  } catch {
    return null;
  }
}

/**
 * The part of a message that is named after its type, or the message itself where it is flat.
 * @param {Record<string, any>} message
 * @param {string} [name]
 * @returns {any}
 */
export function body(message, name = message.type) {
  const inner = message[name];
  return inner && typeof inner === "object" ? inner : message;
}

/**
 * A picture: 4 bytes with the header's length (big-endian), the header in JSON, then the JPEG.
 * @param {ArrayBuffer} data
 * @returns {{header: import("./types.js").VideoHeader, jpeg: Uint8Array<ArrayBuffer>}|null}
 */
export function readVideo(data) {
  if (data.byteLength < 4) return null;
  const length = new DataView(data).getUint32(0);
  if (length > HEADER_LIMIT || 4 + length >= data.byteLength) return null;
  const header = readMessage(new TextDecoder().decode(new Uint8Array(data, 4, length)));
  if (!header || header.type !== "video" || !Number.isFinite(header.sequence)) return null;
  return { header: /** @type {any} */ (header), jpeg: new Uint8Array(data, 4 + length) };
}
