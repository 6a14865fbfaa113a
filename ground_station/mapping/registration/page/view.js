"use strict";
/** A canvas with a view that is moved and zoomed, by mouse, finger, wheel and keys. */

const CLICK_PX = 4;

/** `up` is 1 where its y grows upwards, else -1. */
class View {
  constructor(id, up, bounds, draw, click) {
    Object.assign(this, { canvas: byId(id), up, bounds, draw, click, x: 0, y: 0, scale: 0, dirty: true, touched: false, hover: null });
    this.context = this.canvas.getContext("2d");
    new ResizeObserver(() => this.resized()).observe(this.canvas);
    this.listen();
  }

  resized() {
    const { clientWidth, clientHeight } = this.canvas;
    const ratio = devicePixelRatio;
    this.canvas.width = Math.round(clientWidth * ratio);
    this.canvas.height = Math.round(clientHeight * ratio);
    if (!this.touched) this.fit();
    this.dirty = true;
  }

  fit() {
    const box = this.bounds();
    if (!box) return;
    const [x0, y0, x1, y1] = box;
    const { clientWidth, clientHeight } = this.canvas;
    this.scale = 0.94 * Math.min(clientWidth / Math.max(x1 - x0, 1e-9), clientHeight / Math.max(y1 - y0, 1e-9));
    this.x = (x0 + x1) / 2;
    this.y = (y0 + y1) / 2;
    this.touched = false;
    this.dirty = true;
  }

  toScreen(x, y) {
    const { clientWidth, clientHeight } = this.canvas;
    return [clientWidth / 2 + (x - this.x) * this.scale, clientHeight / 2 - this.up * (y - this.y) * this.scale];
  }

  toWorld(u, v) {
    const { clientWidth, clientHeight } = this.canvas;
    return [this.x + (u - clientWidth / 2) / this.scale, this.y - (this.up * (v - clientHeight / 2)) / this.scale];
  }

  zoom(factor, u, v) {
    const [x, y] = this.toWorld(u, v);
    this.scale *= factor;
    this.x = x - (u - this.canvas.clientWidth / 2) / this.scale;
    this.y = y + (this.up * (v - this.canvas.clientHeight / 2)) / this.scale;
    this.touched = this.dirty = true;
  }

  pan(du, dv) {
    this.x -= du / this.scale;
    this.y += (this.up * dv) / this.scale;
    this.touched = this.dirty = true;
  }

  /** Where an event is, in parts of a pixel: offsetX would be cut to whole ones. */
  at(event) {
    const { left, top } = this.canvas.getBoundingClientRect();
    return [event.clientX - left - this.canvas.clientLeft, event.clientY - top - this.canvas.clientTop];
  }

  listen() {
    let from = null;
    let moved = 0;
    const { canvas } = this;
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      from = [event.clientX, event.clientY];
      moved = 0;
    });
    canvas.addEventListener("pointermove", (event) => {
      if (from) {
        const [du, dv] = [event.clientX - from[0], event.clientY - from[1]];
        moved = Math.max(moved, Math.hypot(du, dv));
        if (moved < CLICK_PX) return;
        this.pan(du, dv);
        from = [event.clientX, event.clientY];
        moved = Infinity;
      } else {
        this.hover = this.at(event);
        this.dirty = true;
      }
    });
    canvas.addEventListener("pointerup", (event) => {
      const is_click = from && moved < CLICK_PX && event.button === 0;
      from = null;
      if (is_click && this.scale > 0) this.click(...this.toWorld(...this.at(event)));
    });
    canvas.addEventListener("pointercancel", () => (from = null));
    canvas.addEventListener("pointerleave", () => {
      this.hover = null;
      this.dirty = true;
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      const delta = event.deltaY * (event.deltaMode === 1 ? 16 : 1);
      this.zoom(Math.exp(-0.0015 * Math.max(-300, Math.min(300, delta))), ...this.at(event));
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const middle = [canvas.clientWidth / 2, canvas.clientHeight / 2];
      const act = {
        ArrowLeft: () => this.pan(40, 0), ArrowRight: () => this.pan(-40, 0),
        ArrowUp: () => this.pan(0, 40), ArrowDown: () => this.pan(0, -40),
        "+": () => this.zoom(1.25, ...middle), "-": () => this.zoom(0.8, ...middle), 0: () => this.fit(),
      }[event.key];
      if (!act) return;
      event.preventDefault();
      act();
    });
  }

  paint() {
    if (!this.dirty) return;
    this.dirty = false;
    if (!(this.scale > 0)) this.fit();
    const c = this.context;
    c.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, 0, 0);
    c.clearRect(0, 0, this.canvas.clientWidth, this.canvas.clientHeight);
    if (this.scale > 0) this.draw(c, this);
  }
}

