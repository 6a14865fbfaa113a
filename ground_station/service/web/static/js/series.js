// @ts-check

/** The newest numbers of a quantity, in a ring. */
export class Series {
  /** @param {number} [length] */
  constructor(length = 120) {
    this.values = new Float32Array(length).fill(NaN);
    this.next = 0;
  }

  /** @param {number} value NaN leaves a gap */
  add(value) {
    this.values[this.next] = value;
    this.next = (this.next + 1) % this.values.length;
  }

  clear() {
    this.values.fill(NaN);
  }

  /** Oldest first. @param {number} k */
  at(k) {
    return this.values[(this.next + k) % this.values.length];
  }

  /** @param {number} share 0 to 1 @returns {number} that quantile; NaN without values */
  quantile(share) {
    const sorted = this.values.filter((value) => !Number.isNaN(value)).sort();
    return sorted.length ? sorted[Math.min(sorted.length - 1, Math.floor(share * sorted.length))] : NaN;
  }

  max() {
    let most = -Infinity;
    for (const value of this.values) if (value > most) most = value;
    return most;
  }
}
