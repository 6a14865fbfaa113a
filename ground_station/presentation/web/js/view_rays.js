// @ts-check
/** Where a camera's picture ends, as rays: what a frustum is made of. */

// Half widths of the view at 1 m, where a map does not give its camera: the Pi camera at 640x480.
const HALF_VIEW = [0.638, 0.475];
export const PER_SIDE = 6; // a lens bends the sides
const ROUNDS = 20;
const WIDEST = (65 * Math.PI) / 180; // of a fisheye: farther from its axis nothing is used
const HALVINGS = 40;

/**
 * @typedef {object} Camera
 * @property {number} width_px
 * @property {number} height_px
 * @property {number[][]} K 3x3, pixels
 * @property {number[]} distortion k1, k2, p1, p2, k3, or k1 to k4 of a fisheye
 * @property {string} model opencv5 or fisheye
 */

/**
 * The picture's border, clockwise from its upper left corner, as points x, y on the plane z = 1 of
 * the camera; corner k is at k · PER_SIDE.
 * @param {Camera|null|undefined} camera
 * @returns {number[][]}
 */
export function viewRays(camera) {
  const at = [[0, 0], [1, 0], [1, 1], [0, 1]];
  return at.flatMap((from, k) => {
    const to = at[(k + 1) % 4];
    return Array.from({ length: PER_SIDE }, (_, step) => {
      const [s, t] = from.map((value, axis) => value + ((to[axis] - value) * step) / PER_SIDE);
      if (!camera) return [(2 * s - 1) * HALF_VIEW[0], (2 * t - 1) * HALF_VIEW[1]];
      // The centre of the first pixel is at 0: the picture reaches half a pixel further.
      return undistorted(camera, s * camera.width_px - 0.5, t * camera.height_px - 0.5);
    });
  });
}

/**
 * A pixel on the plane z = 1, by fixed-point iteration as in OpenCV's undistortPoints.
 * @param {Camera} camera @param {number} u @param {number} v
 */
export function undistorted(camera, u, v) {
  const [[fx, , cx], [, fy, cy]] = camera.K;
  const [x0, y0] = [(u - cx) / fx, (v - cy) / fy];
  if (camera.model === "fisheye") return unbent(camera.distortion, x0, y0);
  const [k1, k2, p1, p2, k3] = camera.distortion;
  let [x, y] = [x0, y0];
  for (let round = 0; round < ROUNDS; round += 1) {
    const r2 = x * x + y * y;
    const radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3));
    const dx = 2 * p1 * x * y + p2 * (r2 + 2 * x * x);
    const dy = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y;
    [x, y] = [(x0 - dx) / radial, (y0 - dy) / radial];
  }
  // A model that does not hold out there gives no frustum of its own.
  return Math.abs(x - x0) < 1 && Math.abs(y - y0) < 1 ? [x, y] : [x0, y0];
}

/**
 * The ray of a fisheye's pixel, by bisection; what is farther out is drawn at the widest.
 * @param {number[]} numbers @param {number} x @param {number} y
 */
function unbent([k1, k2, k3, k4], x, y) {
  const r = Math.hypot(x, y);
  let [low, high] = [0, WIDEST];
  for (let round = 0; round < HALVINGS; round += 1) {
    const angle = (low + high) / 2;
    const t = angle * angle;
    if (angle * (1 + t * (k1 + t * (k2 + t * (k3 + t * k4)))) < r) low = angle;
    else high = angle;
  }
  return r > 0 ? [(x / r) * Math.tan(low), (y / r) * Math.tan(low)] : [0, 0];
}
