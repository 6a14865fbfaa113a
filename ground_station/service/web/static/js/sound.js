// @ts-check
const EVERY_MS = 1600;
const NOTES = [
  [0, 880],
  [0.22, 660],
]; // seconds, Hz

/** Two tones again and again. Browsers allow it only after the operator switched it on. */
export class Sound {
  constructor() {
    this.is_on = false;
    this.timer = 0;
    /** @type {AudioContext|null} */
    this.context = null;
  }

  /** @param {boolean} is_on */
  turn(is_on) {
    this.is_on = is_on;
    if (!is_on) {
      this.ring(false);
      return;
    }
    this.context ??= new AudioContext();
    this.context.resume();
    this.tone(0, 880); // so that one hears that it works
  }

  /** @param {boolean} is_wanted */
  ring(is_wanted) {
    const is_due = is_wanted && this.is_on;
    if (is_due === Boolean(this.timer)) return;
    clearInterval(this.timer);
    this.timer = 0;
    if (!is_due) return;
    const play = () => NOTES.forEach(([after_s, hz]) => this.tone(after_s, hz));
    play();
    this.timer = setInterval(play, EVERY_MS);
  }

  /** @param {number} after_s @param {number} hz */
  tone(after_s, hz) {
    if (!this.context) return;
    const at = this.context.currentTime + after_s;
    const tone = this.context.createOscillator();
    const volume = this.context.createGain();
    tone.frequency.value = hz;
    volume.gain.setValueAtTime(0, at);
    volume.gain.linearRampToValueAtTime(0.4, at + 0.02); // without a click
    volume.gain.linearRampToValueAtTime(0, at + 0.2);
    tone.connect(volume).connect(this.context.destination);
    tone.start(at);
    tone.stop(at + 0.22);
  }
}
