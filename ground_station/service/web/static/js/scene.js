// @ts-check
/** The map and the camera in three dimensions. */
import { byId, canvasById, fitCanvas, setAttribute, setText, show, watchBox } from "./dom.js";
import { listen } from "./gestures.js";
import { Orbit } from "./orbit.js";
import { floorGrid, frustum, landmarkPoints, trailLines } from "./scene_shapes.js";
import { viewRays } from "./view_rays.js";
import { Renderer, Shape } from "./webgl.js";

const POINT_PX = 45;
const DRAW_MS = 60; // it is a view to look around in, the numbers are elsewhere

export class Scene {
  /** @param {import("./store.js").Store} store @param {import("./loop.js").Loop} loop @param {import("./theme.js").Theme} theme */
  constructor(store, loop, theme) {
    this.store = store;
    this.loop = loop;
    this.theme = theme;
    this.canvas = canvasById("scene-canvas");
    this.empty = byId("scene-empty");
    this.orbit = new Orbit();
    /** @type {import("./maps.js").LoadedMap|null} */
    this.map = null;
    /** @type {import("./plan_bitmap.js").PlanBitmap|null} */
    this.bitmap = null;
    this.rays = viewRays(null);
    this.is_following = false;
    this.is_fitted = true;
    this.trail_drawn = "";
    this.box = watchBox(this.canvas, () => this.resized());
    this.canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault();
      this.renderer = null;
    });
    this.canvas.addEventListener("webglcontextrestored", () => this.start());
    listen(this.canvas, {
      drag: (dx, dy) => this.move(() => this.orbit.turn(dx, dy)),
      shift: (dx, dy) => this.move(() => this.orbit.shift(dx, dy, this.box.height)),
      zoom: (factor) => this.move(() => this.orbit.zoom(factor)),
      reset: () => this.fit(),
    });
    byId("scene-fit").addEventListener("click", () => this.fit());
    byId("scene-follow").addEventListener("click", () => this.follow(!this.is_following));
    this.start();
    loop.add(["scene", "theme", "estimate", "trail", "payload", "stale"], () => this.draw(), DRAW_MS);
  }

  start() {
    /** @type {Renderer|null} */
    this.renderer = null;
    const gl = this.canvas.getContext("webgl", { antialias: true, alpha: false, powerPreference: "low-power" });
    show(this.empty, !gl);
    if (!gl) {
      setText(this.empty, "This browser has no WebGL: no 3D view");
      return;
    }
    this.renderer = new Renderer(gl);
    this.points = new Shape(gl, gl.POINTS);
    this.trail = new Shape(gl, gl.LINES);
    this.faces = new Shape(gl, gl.TRIANGLES);
    this.edges = new Shape(gl, gl.LINES);
    this.grid = new Shape(gl, gl.LINES);
    this.fill();
  }

  /** @param {import("./maps.js").LoadedMap|null} map @param {import("./plan_bitmap.js").PlanBitmap|null} bitmap the floor plan's */
  setMap(map, bitmap) {
    if (map?.name !== this.map?.name) this.is_fitted = true;
    this.map = map;
    this.bitmap = bitmap;
    this.rays = viewRays(map?.details.camera);
    this.fill();
    this.resized();
  }

  /** The map's own shapes, again. */
  fill() {
    this.trail_drawn = "";
    if (!this.renderer || !this.points || !this.grid) return;
    const { map, bitmap, theme } = this;
    this.points.set(map ? landmarkPoints(map.landmarks, map.bounds, theme) : new Float32Array());
    const has_plan = Boolean(map?.plan && bitmap);
    this.grid.set(has_plan ? new Float32Array() : floorGrid(map?.bounds ?? { min: [-6, -4, 0], max: [6, 4, 3] }, theme));
    if (has_plan && bitmap) {
      const { canvas, resolution_m, origin } = bitmap;
      const [w, h] = [canvas.width * resolution_m, canvas.height * resolution_m];
      const [c, s] = [Math.cos(origin[2]), Math.sin(origin[2])];
      const corners = [[0, 0], [w, 0], [w, h], [0, h]].map(([a, b]) => [origin[0] + a * c - b * s, origin[1] + a * s + b * c, 0]);
      this.renderer.setPlane(canvas, corners);
    } else this.renderer.setPlane(null, []);
    this.loop.mark("scene");
  }

  resized() {
    if (this.is_fitted) {
      this.orbit.fit(this.map?.bounds ?? { min: [-6, -4, 0], max: [6, 4, 3] }, this.box.width / this.box.height);
    }
    this.loop.mark("scene");
  }

  fit() {
    this.is_fitted = true;
    this.follow(false);
    this.resized();
  }

  /** @param {boolean} is_on */
  follow(is_on) {
    this.is_following = is_on;
    setAttribute(byId("scene-follow"), "aria-pressed", String(is_on));
    if (is_on) {
      this.is_fitted = false;
      this.orbit.distance_m = Math.min(this.orbit.distance_m, 9);
    }
    this.loop.mark("scene");
  }

  /** @param {() => void} act */
  move(act) {
    act();
    this.is_fitted = false;
    this.loop.mark("scene");
  }

  draw() {
    const { renderer, store, theme } = this;
    if (!renderer || !this.points || !this.trail || !this.faces || !this.edges || !this.grid) return;
    const payload = store.current;
    const placed = payload?.placed ?? null;
    if (this.is_following && placed?.position_m) this.orbit.target = [...placed.position_m];
    const version = payload ? `${payload.id}/${payload.trail.version}` : "";
    if (version !== this.trail_drawn) {
      this.trail.set(payload ? trailLines(payload.trail, theme) : new Float32Array());
      this.trail_drawn = version;
    }
    const state = store.stateOf(payload);
    const shapes = placed ? frustum(placed, this.rays, state, theme, 0) : { faces: new Float32Array(), lines: new Float32Array() };
    this.faces.set(shapes.faces);
    this.edges.set(shapes.lines);
    const ratio = fitCanvas(this.canvas, this.box);
    const { width, height } = this.canvas;
    renderer.clear(theme.rgb("scene"), width, height);
    const clip = this.orbit.matrix(width / height);
    renderer.drawPlane(clip);
    renderer.draw(clip, this.grid);
    renderer.draw(clip, this.points, POINT_PX * ratio);
    renderer.draw(clip, this.trail);
    renderer.draw(clip, this.edges);
    renderer.draw(clip, this.faces, 1, false);
  }
}
