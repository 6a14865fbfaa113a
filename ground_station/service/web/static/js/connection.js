// @ts-check
/**
 * The WebSocket that comes back by itself. It knows since when it has been off, waits longer after
 * each failure, and takes silence for a broken connection: the station speaks four times a second.
 */
import { readMessage, readVideo } from "./protocol.js";

const FIRST_WAIT_MS = 500;
const LONGEST_WAIT_MS = 10_000;
const SILENCE_MS = 5_000;
const PING_MS = 5_000;
const SESSION_ENDED = 4401;

/**
 * @typedef {object} Status
 * @property {"connecting"|"open"|"waiting"|"refused"} phase
 * @property {number} since_ms monotonic: open since, or off since
 * @property {number} retry_ms monotonic: the next try, while waiting
 * @property {string} reason
 *
 * @typedef {object} Handlers
 * @property {(message: Record<string, any>) => void} message
 * @property {(header: import("./types.js").VideoHeader, jpeg: Uint8Array<ArrayBuffer>) => void} video
 * @property {(status: Status) => void} status
 * @property {() => string} url
 */

export class Connection {
  /** @param {Handlers} handlers */
  constructor(handlers) {
    this.handlers = handlers;
    /** @type {WebSocket|null} */
    this.socket = null;
    this.failures = 0;
    this.heard_ms = 0;
    this.retry = 0;
    /** @type {Status} */
    this.status = { phase: "connecting", since_ms: performance.now(), retry_ms: 0, reason: "" };
    addEventListener("online", () => this.retryNow());
    document.addEventListener("visibilitychange", () => document.hidden || this.retryNow());
    setInterval(() => this.watch(), 1000);
    setInterval(() => this.ping(), PING_MS);
  }

  open() {
    clearTimeout(this.retry);
    this.say("connecting");
    let socket;
    try {
      socket = new WebSocket(this.handlers.url());
    } catch (error) {
      this.lost(String(error));
      return;
    }
    this.socket = socket;
    this.heard_ms = performance.now();
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      if (socket !== this.socket) return;
      this.status.since_ms = performance.now();
      this.say("open");
      for (let k = 0; k < 3; k += 1) setTimeout(() => this.ping(), 200 * k);
    };
    socket.onmessage = (event) => socket === this.socket && this.heard(event.data);
    socket.onclose = (event) => socket === this.socket && this.lost(event.reason, event.code);
  }

  /** Leaves what it is connected to for what the address is now. */
  reopen() {
    const before = this.socket;
    this.socket = null; // its end is no loss
    before?.close();
    this.failures = 0;
    this.open();
  }

  /** Tries at once instead of at the end of the wait. */
  retryNow() {
    if (this.status.phase === "waiting") this.open();
  }

  /** @param {Record<string, any>} message @returns {boolean} whether it went out */
  send(message) {
    if (this.socket?.readyState !== WebSocket.OPEN) return false;
    this.socket.send(JSON.stringify(message));
    return true;
  }

  ping() {
    this.send({ type: "ping", sent_ms: performance.now() });
  }

  /** @param {string|ArrayBuffer} data */
  heard(data) {
    this.heard_ms = performance.now();
    if (typeof data === "string") {
      const message = readMessage(data);
      if (message?.type === "hello") this.failures = 0; // it serves, it does not only accept
      if (message) this.handlers.message(message);
    } else {
      const video = readVideo(data);
      if (video) this.handlers.video(video.header, video.jpeg);
    }
  }

  watch() {
    if (!this.socket || this.status.phase === "waiting") return;
    if (performance.now() - this.heard_ms > SILENCE_MS) {
      this.socket.close();
      this.lost("the station was silent");
    }
  }

  /** @param {string} reason @param {number} [code] of the close frame */
  lost(reason, code = 0) {
    this.socket = null;
    const now_ms = performance.now();
    if (this.status.phase === "open") this.status.since_ms = now_ms;
    const wait_ms = Math.min(LONGEST_WAIT_MS, FIRST_WAIT_MS * 2 ** Math.min(this.failures, 10));
    this.failures += 1;
    // Pages that lost the same station do not come back in the same instant.
    const spread_ms = wait_ms * (0.8 + 0.4 * Math.random());
    this.status.retry_ms = now_ms + spread_ms;
    this.status.reason = reason;
    if (code !== SESSION_ENDED) this.retry = setTimeout(() => this.open(), spread_ms);
    this.say(code === SESSION_ENDED ? "refused" : "waiting");
  }

  /** @param {Status["phase"]} phase */
  say(phase) {
    this.status.phase = phase;
    this.handlers.status(this.status);
  }
}
