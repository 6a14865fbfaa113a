// @ts-check
import { lookAt, multiply, perspective } from "./mat4.js";

const FOV_RAD = 0.8;
const RAD_PER_PX = 0.006;
const NEAREST_M = 0.5;
const FARTHEST_M = 300;

/** An eye that turns about a point; z is up. */
export class Orbit {
  constructor() {
    this.target = [0, 0, 1];
    this.yaw_rad = -2.1;
    this.pitch_rad = 0.75;
    this.distance_m = 20;
  }

  /** @param {{min: number[], max: number[]}} bounds @param {number} aspect of the picture */
  fit(bounds, aspect) {
    const size = bounds.max.map((high, axis) => high - bounds.min[axis]);
    this.target = bounds.max.map((high, axis) => (high + bounds.min[axis]) / 2);
    this.target[2] = bounds.min[2] + 0.3 * size[2];
    this.yaw_rad = -2.1;
    this.pitch_rad = 0.75;
    const half_m = Math.hypot(size[0], size[1]) / 2;
    this.distance_m = Math.min(FARTHEST_M, half_m / Math.tan(FOV_RAD / 2) / Math.min(1, aspect / 1.35));
  }

  /** @param {number} dx @param {number} dy */
  turn(dx, dy) {
    this.yaw_rad -= dx * RAD_PER_PX;
    this.pitch_rad = Math.min(1.55, Math.max(-0.3, this.pitch_rad + dy * RAD_PER_PX));
  }

  /** Moves the target in the ground's plane. @param {number} dx @param {number} dy @param {number} height_px */
  shift(dx, dy, height_px) {
    const metres = (2 * this.distance_m * Math.tan(FOV_RAD / 2)) / Math.max(1, height_px);
    const [c, s] = [Math.cos(this.yaw_rad), Math.sin(this.yaw_rad)];
    this.target[0] += metres * (s * dx - c * dy);
    this.target[1] += metres * (-c * dx - s * dy);
  }

  /** @param {number} factor */
  zoom(factor) {
    this.distance_m = Math.min(FARTHEST_M, Math.max(NEAREST_M, this.distance_m / factor));
  }

  eye() {
    const flat = Math.cos(this.pitch_rad) * this.distance_m;
    return [
      this.target[0] + flat * Math.cos(this.yaw_rad),
      this.target[1] + flat * Math.sin(this.yaw_rad),
      this.target[2] + Math.sin(this.pitch_rad) * this.distance_m,
    ];
  }

  /** World to clip space. @param {number} aspect */
  matrix(aspect) {
    const far_m = this.distance_m + 200;
    const view = lookAt(this.eye(), this.target, [0, 0, 1]);
    return multiply(perspective(FOV_RAD, aspect, Math.max(0.05, this.distance_m / 100), far_m), view);
  }
}
