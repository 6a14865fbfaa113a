// @ts-check
/** Landmarks and keyframes in three dimensions. */
import { colourAt } from "./colours.js";
import { byId, canvasById, fitCanvas, setText, show, watchBox } from "./dom.js";
import { listen } from "./gestures.js";
import { rotate } from "./mat4.js";
import { Orbit } from "./orbit.js";
import { PER_SIDE, viewRays } from "./view_rays.js";
import { Renderer, Shape } from "./webgl.js";

const POINT_PX = 42; // of a point one metre away
const FRUSTUM = 0.012; // of the map's longer side
const FRUSTUM_RGB = [1, 0.62, 0.36]; // the scene is dark in both themes
const LINE_RGB = [0.28, 0.33, 0.38];

export class Cloud {
  /**
   * @param {any} meta @param {(name: string) => Float32Array|Int32Array} array
   * @param {import("./theme.js").Theme} theme @param {(name: string) => import("./colours.js").Scale} scaleOf
   */
  constructor(meta, array, theme, scaleOf) {
    this.meta = meta;
    this.theme = theme;
    this.scaleOf = scaleOf;
    this.points = array("point");
    this.values = { height: this.points.filter((_, k) => k % 3 === 2), observations: array("point-observations"), sigma: array("point-sigma") };
    this.camera_place = array("camera-place");
    this.camera_turn = array("camera-turn");
    this.colour = "height";
    this.shows = { keyframes: true, plan: true };
    this.orbit = new Orbit();
    this.is_fitted = true;
    this.asked = false;
    /** @type {HTMLCanvasElement|null} */
    this.plan = null;
    this.canvas = canvasById("cloud");
    this.box = watchBox(this.canvas, () => this.resized());
    listen(this.canvas, {
      drag: (dx, dy) => this.move(() => this.orbit.turn(dx, dy)),
      shift: (dx, dy) => this.move(() => this.orbit.shift(dx, dy, this.box.height)),
      zoom: (factor) => this.move(() => this.orbit.zoom(factor)),
      reset: () => this.fit(),
    });
    this.canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault();
      this.renderer = null;
    });
    this.canvas.addEventListener("webglcontextrestored", () => this.start());
    this.start();
  }

  start() {
    const gl = this.canvas.getContext("webgl", { antialias: true, alpha: false, powerPreference: "low-power" });
    /** @type {Renderer|null} */
    this.renderer = gl ? new Renderer(gl) : null;
    show(byId("cloud-none"), !gl);
    show(this.canvas, Boolean(gl));
    if (!gl) {
      setText(byId("cloud-none"), "This browser has no WebGL: no 3D view. All else on this page works without.");
      return;
    }
    this.landmarks = new Shape(gl, gl.POINTS);
    this.cameras = new Shape(gl, gl.LINES);
    this.floor = new Shape(gl, gl.LINES);
    this.fill();
  }

  /** @param {HTMLCanvasElement|null} picture of the floor plan, in the theme's colours */
  setPlan(picture) {
    this.plan = picture;
    this.fill();
  }

  /** @param {string} name height, observations or sigma */
  colourBy(name) {
    this.colour = name;
    this.fill();
  }

  fill() {
    if (!this.renderer || !this.landmarks || !this.cameras || !this.floor) return;
    const { points, meta } = this;
    const values = this.values[/** @type {"height"} */ (this.colour)];
    const scale = this.scaleOf(this.colour);
    const vertices = new Float32Array((points.length / 3) * 7);
    for (let k = 0; k < values.length; k += 1) {
      const [r, g, b] = colourAt(meta.vivid, scale.share(values[k]));
      vertices.set([points[3 * k], points[3 * k + 1], points[3 * k + 2], r, g, b, 1], 7 * k);
    }
    this.landmarks.set(vertices);
    this.cameras.set(this.frustums());
    this.floor.set(this.plan ? new Float32Array() : this.grid());
    this.renderer.setPlane(this.plan, this.plan ? meta.plan.corners : []);
    this.ask();
  }

  frustums() {
    const { min, max } = this.meta.bounds;
    const size = FRUSTUM * Math.max(max[0] - min[0], max[1] - min[1]);
    const rays = viewRays(this.meta.camera).filter((_, k) => k % PER_SIDE === 0);
    const [r, g, b] = FRUSTUM_RGB;
    /** @type {number[]} */
    const out = [];
    const add = (/** @type {number[][]} */ ...ends) => ends.forEach((p) => out.push(p[0], p[1], p[2], r, g, b, 1));
    for (let k = 0; k < this.camera_place.length / 3; k += 1) {
      const eye = Array.from(this.camera_place.subarray(3 * k, 3 * k + 3));
      const turn = Array.from(this.camera_turn.subarray(4 * k, 4 * k + 4));
      const corners = rays.map(([x, y]) => rotate(turn, [x * size, y * size, size]).map((value, axis) => eye[axis] + value));
      corners.forEach((corner, side) => add(eye, corner, corner, corners[(side + 1) % corners.length]));
    }
    return new Float32Array(out);
  }

  /** Lines under a map without a plan. */
  grid() {
    const { min, max } = this.meta.bounds;
    const [r, g, b] = LINE_RGB;
    const step = Math.max(1, Math.ceil(Math.max(max[0] - min[0], max[1] - min[1]) / 40));
    /** @type {number[]} */
    const out = [];
    const add = (/** @type {number} */ x, /** @type {number} */ y) => out.push(x, y, min[2], r, g, b, 1);
    for (let x = Math.floor(min[0]); x <= max[0] + step; x += step) (add(x, min[1]), add(x, max[1]));
    for (let y = Math.floor(min[1]); y <= max[1] + step; y += step) (add(min[0], y), add(max[0], y));
    return new Float32Array(out);
  }

  resized() {
    if (this.is_fitted) this.orbit.fit(this.meta.bounds, this.box.width / Math.max(1, this.box.height));
    this.ask();
  }

  fit() {
    this.is_fitted = true;
    this.resized();
  }

  /** @param {() => void} act */
  move(act) {
    act();
    this.is_fitted = false;
    this.ask();
  }

  ask() {
    if (this.asked) return;
    this.asked = true;
    requestAnimationFrame(() => this.draw());
  }

  draw() {
    this.asked = false;
    const { renderer, landmarks, cameras, floor } = this;
    if (!renderer || !landmarks || !cameras || !floor) return;
    const ratio = fitCanvas(this.canvas, this.box);
    const { width, height } = this.canvas;
    renderer.clear(this.theme.rgb("scene"), width, height);
    const clip = this.orbit.matrix(width / height);
    if (this.shows.plan) renderer.drawPlane(clip);
    renderer.draw(clip, floor);
    renderer.draw(clip, landmarks, POINT_PX * ratio);
    if (this.shows.keyframes) renderer.draw(clip, cameras);
  }
}
