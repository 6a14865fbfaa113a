// @ts-check
/**
 * The station's wall clock, as the page sees it. The page's own wall clock is never used: a tablet
 * may be minutes off. Round trips give the offset; the shortest of the last ones counts, as in NTP.
 */

const KEPT = 8;

export class StationClock {
  /** @param {() => number} monotonic_ms */
  constructor(monotonic_ms = () => performance.now()) {
    this.monotonic_ms = monotonic_ms;
    /** @type {{rtt_ms: number, offset_ms: number}[]} */
    this.samples = [];
    this.offset_ms = NaN;
    /** Half the round trip that the offset comes from. */
    this.uncertainty_ms = NaN;
  }

  /** A time that came without a question: it is late by an unknown way. @param {number} time_ns */
  hello(time_ns) {
    this.samples = [];
    this.offset_ms = time_ns / 1e6 - this.monotonic_ms();
    this.uncertainty_ms = NaN;
  }

  /** @param {number} sent_ms monotonic @param {number} time_ns the answer's */
  pong(sent_ms, time_ns) {
    const rtt_ms = this.monotonic_ms() - sent_ms;
    if (!(rtt_ms >= 0) || !Number.isFinite(time_ns)) return;
    this.samples.push({ rtt_ms, offset_ms: time_ns / 1e6 - (sent_ms + rtt_ms / 2) });
    if (this.samples.length > KEPT) this.samples.shift();
    const best = this.samples.reduce((a, b) => (b.rtt_ms < a.rtt_ms ? b : a));
    this.offset_ms = best.offset_ms;
    this.uncertainty_ms = best.rtt_ms / 2;
  }

  /** Milliseconds since 1970 by the station; NaN before the first hello. */
  now_ms() {
    return this.monotonic_ms() + this.offset_ms;
  }

  /** @param {number|null|undefined} time_ns @returns {number} seconds ago; NaN where unknown */
  age_s(time_ns) {
    return time_ns == null ? NaN : (this.now_ms() - time_ns / 1e6) / 1e3;
  }
}
