// @ts-check
/** The floor plan's picture in colours of the page. */

const LONGEST_PX = 2000;

/**
 * Grey levels become colours between wall and free space.
 * @param {HTMLImageElement} image @param {number[]} wall 0 to 1 @param {number[]} free
 * @returns {HTMLCanvasElement}
 */
export function tinted(image, wall, free) {
  const canvas = document.createElement("canvas");
  const shrink = Math.min(1, LONGEST_PX / Math.max(image.naturalWidth, image.naturalHeight));
  canvas.width = Math.max(1, Math.round(image.naturalWidth * shrink));
  canvas.height = Math.max(1, Math.round(image.naturalHeight * shrink));
  const c = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d", { willReadFrequently: true }));
  c.drawImage(image, 0, 0, canvas.width, canvas.height);
  const pixels = c.getImageData(0, 0, canvas.width, canvas.height);
  for (let k = 0; k < pixels.data.length; k += 4) {
    const grey = pixels.data[k] / 255;
    for (let channel = 0; channel < 3; channel += 1) {
      pixels.data[k + channel] = 255 * (wall[channel] + (free[channel] - wall[channel]) * grey);
    }
  }
  c.putImageData(pixels, 0, 0);
  return canvas;
}

/** Slanted lines for a fill that is told apart without its colour. @param {CanvasRenderingContext2D} c @param {string} colour @param {string} ground */
export function hatching(c, colour, ground) {
  const tile = document.createElement("canvas");
  tile.width = tile.height = 8;
  const t = /** @type {CanvasRenderingContext2D} */ (tile.getContext("2d"));
  t.fillStyle = ground;
  t.fillRect(0, 0, 8, 8);
  t.strokeStyle = colour;
  t.lineWidth = 2;
  t.beginPath();
  for (const shift of [-8, 0, 8]) {
    t.moveTo(shift - 1, 9);
    t.lineTo(shift + 9, -1);
  }
  t.stroke();
  return /** @type {CanvasPattern} */ (c.createPattern(tile, "repeat"));
}
