// @ts-check
/** The strip at the top: state with its reason, and the numbers of the flight. */
import { byId, fields, setAttribute, setIcon, setText, show } from "./dom.js";
import { clockTime, duration, number, UNKNOWN } from "./format.js";
import { ellipseOf } from "./ellipse.js";
import { lookOf } from "./states.js";

const TEXT_MS = 150; // numbers that change faster cannot be read
const LOOPBACK = "this station listens on its own computer only; for the network: blimp serve --lan";
const STEPS = "N, or the list above, shows the steps from payload to flight";
const HAND_STEP_DEG = 1;

export class Panel {
  /** @param {import("./types.js").Shared} shared */
  constructor({ store, loop }) {
    this.store = store;
    this.f = fields(byId("flight"));
    this.hand = byId("dial-hand");
    this.spoken = byId("say-state");
    this.said = "";
    loop.add(["estimate", "payload", "tick", "selection", "station"], () => this.draw(), TEXT_MS);
  }

  draw() {
    const { store, f } = this;
    const payload = store.current;
    const state = store.stateOf(payload);
    const look = lookOf(state);
    setAttribute(f.box, "data-state", look.key);
    setIcon(f.icon, look.icon);
    setText(f.word, look.word);
    setText(f.since, this.since(payload, state));
    const reason = this.reason(payload, state);
    setText(f.reason, reason);
    setAttribute(f.reason, "title", reason);
    this.speak(payload, look.word);

    const estimate = payload?.estimate;
    const is_now = (state === "TRACKING" || state === "DEGRADED") && Boolean(estimate?.position_m);
    const shown = is_now ? estimate : payload?.placed;
    const is_old = Boolean(shown) && !is_now;
    setAttribute(f.metrics, "data-stale", is_old ? "true" : null);
    show(f.old, is_old);
    if (is_old && payload) setText(f.old, `last known, ${duration((performance.now() - payload.placed_ms) / 1e3)} ago`);
    const [x, y, z] = shown?.position_m ?? [];
    setText(f.height, number(shown?.height_m ?? z, 2));
    setText(f.speed, number(shown?.speed_mps, 2));
    setText(f.heading, heading(shown?.heading_deg));
    setText(f.x, number(x, 2));
    setText(f.y, number(y, 2));
    setText(f.z, number(z, 2));
    setText(f.sigma, number(worst_cm(shown?.position_sigma_m), 1));
    const turn = HAND_STEP_DEG * Math.round((shown?.heading_deg ?? 0) / HAND_STEP_DEG);
    setAttribute(this.hand, "transform", `rotate(${-turn})`);
  }

  /** @param {import("./store.js").Payload|null} payload @param {string} state */
  since(payload, state) {
    if (!payload) return "";
    const now_ms = performance.now();
    if (state === "GONE") return payload.note ? `since ${clockTime(payload.note.seen_ns / 1e6)}` : "";
    if (state === "OFFLINE") return "";
    if (state === "STALE") return `for ${duration((now_ms - payload.estimate_ms) / 1e3)}`;
    return payload.estimate ? `for ${duration((now_ms - payload.state_ms) / 1e3)}` : "";
  }

  /** @param {import("./store.js").Payload|null} payload @param {string} state */
  reason(payload, state) {
    if (state === "NONE" && this.store.station.loopback) return `${lookOf(state).meaning}: ${LOOPBACK}`;
    if (state === "NONE") return `${lookOf(state).meaning}: ${STEPS}`;
    if (["GONE", "OFFLINE", "STALE"].includes(state) || !payload?.estimate) return lookOf(state).meaning;
    const estimate = payload.estimate;
    if (estimate.reason) return estimate.reason;
    const inliers = estimate.inliers ? `, ${estimate.inliers} landmarks` : "";
    return lookOf(state).meaning + inliers;
  }

  /** Tells a screen reader when the state is another. @param {import("./store.js").Payload|null} payload @param {string} word */
  speak(payload, word) {
    const text = payload ? `${payload.id}: ${word}` : word;
    if (text === this.said) return;
    this.said = text;
    setText(this.spoken, text);
  }
}

/** @param {number|null|undefined} degrees */
function heading(degrees) {
  if (degrees == null || !Number.isFinite(degrees)) return UNKNOWN;
  return number(((Math.round(degrees) % 360) + 360) % 360);
}

/** The longest half axis on the floor, or the height's where that is worse. @param {number[]|null|undefined} p */
function worst_cm(p) {
  if (!p) return NaN;
  const flat = ellipseOf(p[0], p[1], p[4], 2);
  return flat ? 100 * Math.max(flat.major_m, 2 * Math.sqrt(Math.max(0, p[8]))) : NaN;
}
