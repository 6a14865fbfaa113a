// @ts-check
/** Draws only what changed, at most once a frame of the screen, and never in a hidden tab. */

/**
 * @typedef {object} View
 * @property {Set<string>} topics
 * @property {() => void} draw
 * @property {number} every_ms least time between two draws
 * @property {number} drawn_ms
 * @property {boolean} dirty
 */

export class Loop {
  constructor() {
    /** @type {View[]} */
    this.views = [];
    this.asked = 0;
    this.later = 0;
    this.run = this.run.bind(this);
    document.addEventListener("visibilitychange", () => document.hidden || this.ask());
  }

  /**
   * @param {string[]} topics any of which makes it dirty @param {() => void} draw
   * @param {number} [every_ms]
   */
  add(topics, draw, every_ms = 0) {
    this.views.push({ topics: new Set(topics), draw, every_ms, drawn_ms: -1e9, dirty: true });
    this.ask();
  }

  /** @param {string} topic */
  mark(topic) {
    let found = false;
    for (const view of this.views) {
      if (view.topics.has(topic)) {
        view.dirty = true;
        found = true;
      }
    }
    if (found) this.ask();
  }

  ask() {
    if (!this.asked) this.asked = requestAnimationFrame(this.run);
  }

  /** @param {number} now_ms */
  run(now_ms) {
    this.asked = 0;
    let soonest_ms = Infinity;
    for (const view of this.views) {
      if (!view.dirty) continue;
      const wait_ms = view.drawn_ms + view.every_ms - now_ms;
      if (wait_ms > 4) {
        soonest_ms = Math.min(soonest_ms, wait_ms);
        continue;
      }
      view.dirty = false;
      view.drawn_ms = now_ms;
      view.draw();
    }
    if (soonest_ms < Infinity && !this.later) {
      this.later = setTimeout(() => {
        this.later = 0;
        this.ask();
      }, soonest_ms);
    }
  }
}
