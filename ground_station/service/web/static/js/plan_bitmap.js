// @ts-check
/** The floor plan and the landmarks in one picture of the theme's colours, made once a map. */

const LONGEST_PX = 2400;
const GRID_RESOLUTION_M = 0.05;

/**
 * @typedef {object} PlanBitmap
 * @property {HTMLCanvasElement} canvas
 * @property {number} resolution_m
 * @property {number[]} origin x, y (m) and yaw (rad) of the lower left corner
 */

/**
 * @param {import("./maps.js").LoadedMap} map @param {import("./theme.js").Theme} theme
 * @returns {PlanBitmap|null}
 */
export function planBitmap(map, theme) {
  const canvas = document.createElement("canvas");
  const context = canvas.getContext("2d", { willReadFrequently: true });
  if (!context) return null;
  const found = map.details.floorplan;
  let resolution_m = GRID_RESOLUTION_M;
  let origin = [map.bounds.min[0], map.bounds.min[1], 0];
  if (map.plan && found) {
    const shrink = Math.min(1, LONGEST_PX / Math.max(map.plan.width, map.plan.height));
    canvas.width = Math.round(map.plan.width * shrink);
    canvas.height = Math.round(map.plan.height * shrink);
    resolution_m = found.resolution_m / shrink;
    origin = found.origin;
    context.drawImage(map.plan, 0, 0, canvas.width, canvas.height);
    tint(context, theme);
  } else {
    const size_m = [map.bounds.max[0] - origin[0], map.bounds.max[1] - origin[1]];
    resolution_m = Math.max(resolution_m, Math.max(...size_m) / LONGEST_PX);
    canvas.width = Math.max(1, Math.ceil(size_m[0] / resolution_m));
    canvas.height = Math.max(1, Math.ceil(size_m[1] / resolution_m));
  }
  drawLandmarks(context, map.landmarks, resolution_m, origin, theme);
  return { canvas, resolution_m, origin };
}

/** Grey levels become colours between wall and free. */
function tint(/** @type {CanvasRenderingContext2D} */ context, /** @type {import("./theme.js").Theme} */ theme) {
  const { width, height } = context.canvas;
  const wall = theme.rgb("plan-wall");
  const free = theme.rgb("plan-free");
  const image = context.getImageData(0, 0, width, height);
  const levels = [0, 1, 2].map((channel) =>
    Uint8ClampedArray.from({ length: 256 }, (_, grey) => 255 * (wall[channel] + (free[channel] - wall[channel]) * (grey / 255))),
  );
  for (let k = 0; k < image.data.length; k += 4) {
    const grey = image.data[k];
    for (let channel = 0; channel < 3; channel += 1) image.data[k + channel] = levels[channel][grey];
  }
  context.putImageData(image, 0, 0);
}

/**
 * @param {CanvasRenderingContext2D} context @param {Float32Array} landmarks
 * @param {number} resolution_m @param {number[]} origin @param {import("./theme.js").Theme} theme
 */
function drawLandmarks(context, landmarks, resolution_m, origin, theme) {
  const [x0, y0, yaw] = origin;
  const [c, s] = [Math.cos(yaw) / resolution_m, Math.sin(yaw) / resolution_m];
  const height = context.canvas.height;
  context.fillStyle = theme.colour("landmark");
  context.globalAlpha = 0.4;
  for (let k = 0; k < landmarks.length; k += 3) {
    const dx = landmarks[k] - x0;
    const dy = landmarks[k + 1] - y0;
    context.fillRect(dx * c + dy * s - 1, height - (dy * c - dx * s) - 1, 2, 2);
  }
  context.globalAlpha = 1;
}
