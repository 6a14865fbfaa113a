// @ts-check
/** The floor plan's view: what changes with the view below, what flies above. */
import { byId, canvasById, fitCanvas, setAttribute, setText, show, watchBox } from "./dom.js";
import { number } from "./format.js";
import { listen } from "./gestures.js";
import { planBitmap } from "./plan_bitmap.js";
import { drawBlimp, drawEllipse, drawGrid, drawScale, drawTrail } from "./plan_marks.js";
import { View2d } from "./view2d.js";

const ELLIPSE_SIGMAS = 2;
const LABEL = 16; // letters

export class Plan {
  /** @param {import("./store.js").Store} store @param {import("./loop.js").Loop} loop @param {import("./theme.js").Theme} theme */
  constructor(store, loop, theme) {
    this.store = store;
    this.loop = loop;
    this.theme = theme;
    this.view = new View2d();
    this.below = canvasById("plan-below");
    this.above = canvasById("plan-above");
    this.empty = byId("plan-empty");
    this.place = byId("plan-place");
    /** @type {import("./maps.js").LoadedMap|null} */
    this.map = null;
    /** @type {import("./plan_bitmap.js").PlanBitmap|null} */
    this.bitmap = null;
    this.is_following = false;
    this.box = watchBox(this.above, () => this.resized());
    listen(this.above, {
      drag: (dx, dy) => this.move(() => this.view.pan(dx, dy), true),
      shift: (dx, dy) => this.move(() => this.view.pan(dx, dy), true),
      zoom: (factor, x, y) => this.zoom(factor, x, y),
      reset: () => this.fit(),
      hover: (x, y) => this.say(x, y),
      leave: () => setText(this.place, ""),
    });
    byId("plan-fit").addEventListener("click", () => this.fit());
    byId("plan-follow").addEventListener("click", () => this.follow(!this.is_following));
    byId("plan-in").addEventListener("click", () => this.zoomBy(1.4));
    byId("plan-out").addEventListener("click", () => this.zoomBy(1 / 1.4));
    loop.add(["plan-view", "theme"], () => this.drawBelow());
    loop.add(["plan-view", "theme", "estimate", "others", "trail", "payload", "stale"], () => this.drawAbove());
  }

  /** @param {import("./maps.js").LoadedMap|null} map @param {string} problem */
  setMap(map, problem) {
    const is_other = map?.name !== this.map?.name;
    this.map = map;
    this.bitmap = map ? planBitmap(map, this.theme) : null;
    if (map && is_other) this.view.is_fitted = true;
    show(this.empty, !map?.plan);
    setText(this.empty, map ? "This map has no floor plan: metre grid" : problem ? `No map: ${problem}` : "No map yet");
    this.resized();
  }

  /** The colours are others now. */
  recolour() {
    this.bitmap = this.map ? planBitmap(this.map, this.theme) : null;
    this.loop.mark("theme");
  }

  resized() {
    this.view.width = this.box.width;
    this.view.height = this.box.height;
    if (this.view.is_fitted) this.view.fit(this.map?.bounds ?? { min: [-6, -4], max: [6, 4] });
    this.loop.mark("plan-view");
  }

  fit() {
    this.follow(false);
    this.view.is_fitted = true;
    this.resized();
  }

  /** @param {boolean} is_on */
  follow(is_on) {
    this.is_following = is_on;
    setAttribute(byId("plan-follow"), "aria-pressed", String(is_on));
    if (is_on) this.view.is_fitted = false;
    this.loop.mark("plan-view");
  }

  /** @param {() => void} act @param {boolean} ends_following */
  move(act, ends_following) {
    if (ends_following && this.is_following) this.follow(false);
    act();
    this.loop.mark("plan-view");
  }

  /** @param {number} factor */
  zoomBy(factor) {
    this.zoom(factor, this.view.width / 2, this.view.height / 2);
  }

  /** @param {number} factor @param {number} x @param {number} y */
  zoom(factor, x, y) {
    const [cx, cy] = this.is_following ? [this.view.width / 2, this.view.height / 2] : [x, y];
    this.move(() => this.view.zoom(factor, cx, cy), false);
  }

  /** @param {number} x_px @param {number} y_px */
  say(x_px, y_px) {
    const [x, y] = this.view.toWorld(x_px, y_px);
    setText(this.place, `x ${number(x, 1)}  y ${number(y, 1)} m`);
  }

  drawBelow() {
    const c = this.below.getContext("2d");
    if (!c) return;
    const ratio = fitCanvas(this.below, this.box);
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.clearRect(0, 0, this.view.width, this.view.height);
    if (!this.map?.plan) drawGrid(c, this.view, this.theme);
    if (this.bitmap) {
      const { canvas, resolution_m, origin } = this.bitmap;
      const [x, y] = this.view.toScreen(origin[0], origin[1]);
      const scale = this.view.scale * resolution_m;
      c.save();
      c.translate(x, y);
      c.rotate(-origin[2]);
      c.scale(scale, scale);
      c.imageSmoothingEnabled = scale < 2;
      c.drawImage(canvas, 0, -canvas.height);
      c.restore();
    }
    drawScale(c, this.view, this.theme);
  }

  drawAbove() {
    const c = this.above.getContext("2d");
    if (!c) return;
    const { store, view, theme } = this;
    const payload = store.current;
    const placed = payload?.placed;
    if (this.is_following && placed?.position_m) {
      const [x, y] = placed.position_m;
      if (Math.abs(x - view.x_m) + Math.abs(y - view.y_m) > 0.5 / view.scale) {
        view.x_m = x;
        view.y_m = y;
        this.drawBelow();
      }
    }
    const ratio = fitCanvas(this.above, this.box);
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.clearRect(0, 0, view.width, view.height);
    for (const other of store.payloads.values()) {
      if (other === payload || !other.placed || (other.placed.map ?? "") !== (placed?.map ?? other.placed.map ?? "")) continue;
      const state = store.stateOf(other);
      drawBlimp(c, view, theme, other.placed, state, { label: short(other.id), old: !isCurrent(other, state), size: 11 });
    }
    if (!payload) return;
    drawTrail(c, view, theme, payload.trail);
    if (!placed) return;
    const state = store.stateOf(payload);
    const old = !isCurrent(payload, state);
    if (!old) drawEllipse(c, view, theme, placed, state, ELLIPSE_SIGMAS);
    drawBlimp(c, view, theme, placed, state, { old, label: old ? "last known" : "" });
  }
}

/** @param {string} name */
function short(name) {
  return name.length > LABEL ? `${name.slice(0, LABEL - 1)}…` : name;
}

/** @param {import("./store.js").Payload} payload @param {string} state */
function isCurrent(payload, state) {
  return (state === "TRACKING" || state === "DEGRADED") && payload.placed === payload.estimate;
}
