// @ts-check
/** Small helpers around the document. Data become text nodes only, never markup. */

const SVG = "http://www.w3.org/2000/svg";

/** @param {string} id @returns {HTMLElement} */
export function byId(id) {
  const found = document.getElementById(id);
  if (!found) throw new Error(`the page has no #${id}`);
  return found;
}

/** @param {string} id @returns {HTMLCanvasElement} */
export function canvasById(id) {
  return /** @type {HTMLCanvasElement} */ (byId(id));
}

/**
 * @param {string} tag @param {string} [className] @param {(Node|string)[]} children
 * @returns {HTMLElement}
 */
export function make(tag, className = "", ...children) {
  const node = document.createElement(tag);
  if (className) node.className = className;
  node.append(...children);
  return node;
}

/** A symbol of the page's sprite. @param {string} name @param {string} [className] */
export function icon(name, className = "icon") {
  const svg = document.createElementNS(SVG, "svg");
  svg.setAttribute("class", className);
  svg.setAttribute("aria-hidden", "true");
  const use = document.createElementNS(SVG, "use");
  use.setAttribute("href", `#i-${name}`);
  svg.append(use);
  return svg;
}

/** Changes an icon that is there. @param {Element} svg @param {string} name */
export function setIcon(svg, name) {
  const use = svg.querySelector("use");
  if (use && use.getAttribute("href") !== `#i-${name}`) use.setAttribute("href", `#i-${name}`);
}

/** Touches the document only when the text differs. @param {Element} node @param {string} text */
export function setText(node, text) {
  const first = node.firstChild;
  if (first instanceof Text) {
    if (first.data !== text) first.data = text;
  } else if (text) node.prepend(text);
}

/** @param {Element} node @param {string} name @param {string|null} value null removes it */
export function setAttribute(node, name, value) {
  if (value === null) {
    if (node.hasAttribute(name)) node.removeAttribute(name);
  } else if (node.getAttribute(name) !== value) node.setAttribute(name, value);
}

/** @param {HTMLElement} node @param {boolean} shown */
export function show(node, shown) {
  if (node.hidden === shown) node.hidden = !shown;
}

/**
 * The elements marked `data-f="name"` below a node.
 * @param {ParentNode} root @returns {Record<string, HTMLElement>}
 */
export function fields(root) {
  /** @type {Record<string, HTMLElement>} */
  const found = {};
  for (const node of root.querySelectorAll("[data-f]")) {
    const element = /** @type {HTMLElement} */ (node);
    found[/** @type {string} */ (element.dataset.f)] = element;
  }
  return found;
}

/**
 * Fits a canvas to its box in device pixels.
 * @param {HTMLCanvasElement} canvas @param {{width: number, height: number}} box CSS pixels
 * @returns {number} device pixels in a CSS pixel
 */
export function fitCanvas(canvas, box) {
  const ratio = Math.min(devicePixelRatio || 1, 2);
  const width = Math.max(1, Math.round(box.width * ratio));
  const height = Math.max(1, Math.round(box.height * ratio));
  if (canvas.width !== width || canvas.height !== height) {
    canvas.width = width;
    canvas.height = height;
  }
  return ratio;
}

/**
 * Keeps the box of an element without asking for layout in each frame.
 * @param {Element} element @param {() => void} changed
 * @returns {{width: number, height: number}}
 */
export function watchBox(element, changed) {
  const box = { width: 1, height: 1 };
  new ResizeObserver((entries) => {
    const rect = entries[entries.length - 1].contentRect;
    box.width = rect.width;
    box.height = rect.height;
    changed();
  }).observe(element);
  return box;
}
