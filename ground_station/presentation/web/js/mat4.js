// @ts-check
/** 4x4 matrices in columns, as WebGL wants them. */

/** @typedef {Float32Array} Mat4 */

/** @param {Mat4} a @param {Mat4} b @returns {Mat4} a·b */
export function multiply(a, b) {
  const out = new Float32Array(16);
  for (let column = 0; column < 4; column += 1) {
    for (let row = 0; row < 4; row += 1) {
      let sum = 0;
      for (let k = 0; k < 4; k += 1) sum += a[4 * k + row] * b[4 * column + k];
      out[4 * column + row] = sum;
    }
  }
  return out;
}

/** @param {number} fov_rad vertical @param {number} aspect @param {number} near @param {number} far @returns {Mat4} */
export function perspective(fov_rad, aspect, near, far) {
  const f = 1 / Math.tan(fov_rad / 2);
  const out = new Float32Array(16);
  out[0] = f / aspect;
  out[5] = f;
  out[10] = (far + near) / (near - far);
  out[11] = -1;
  out[14] = (2 * far * near) / (near - far);
  return out;
}

/** World to eye. @param {number[]} eye @param {number[]} target @param {number[]} up @returns {Mat4} */
export function lookAt(eye, target, up) {
  const back = unit(minus(eye, target));
  const right = unit(cross(up, back));
  const above = cross(back, right);
  const out = new Float32Array(16);
  for (let axis = 0; axis < 3; axis += 1) {
    out[4 * axis] = right[axis];
    out[4 * axis + 1] = above[axis];
    out[4 * axis + 2] = back[axis];
  }
  out[12] = -dot(right, eye);
  out[13] = -dot(above, eye);
  out[14] = -dot(back, eye);
  out[15] = 1;
  return out;
}

/** @param {ArrayLike<number>} a @param {ArrayLike<number>} b */
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

/** @param {number[]} a @param {number[]} b */
export const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];

/** @param {number[]} a @param {number[]} b */
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

/** @param {number[]} a */
export function unit(a) {
  const length = Math.hypot(a[0], a[1], a[2]) || 1;
  return [a[0] / length, a[1] / length, a[2] / length];
}

/** @param {number[]} quaternion x, y, z, w @param {number[]} v @returns {number[]} the turned vector */
export function rotate(quaternion, v) {
  const [x, y, z, w] = quaternion;
  const t = cross([x, y, z], v).map((value) => 2 * value);
  const u = cross([x, y, z], t);
  return [v[0] + w * t[0] + u[0], v[1] + w * t[1] + u[1], v[2] + w * t[2] + u[2]];
}
