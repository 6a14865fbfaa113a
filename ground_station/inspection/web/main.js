// @ts-check
/** The page of a map: what was given, the two views, and what steers them. */
import { Cloud } from "./cloud.js";
import { drawRamp, length, Scale } from "./colours.js";
import { byId, canvasById, setText, show } from "./dom.js";
import { Layer } from "./layer.js";
import { array, json } from "./payload.js";
import { tinted } from "./picture.js";
import { Theme } from "./theme.js";
import { TopView } from "./top_view.js";

const meta = json("figures");
/** @type {Record<string, Float32Array|Int32Array>} */
const arrays = {};
const get = (/** @type {string} */ name) => (arrays[name] ??= array(name));
const units = meta.units;
const own = (/** @type {number} */ value) => value / meta.scale;

const layer = new Layer(meta.grid, get);
const theme = new Theme(() => recolour());
const top_view = new TopView(meta, get, layer, theme);
/** @type {Record<string, Scale>} */
const scales = {};
const cloud = new Cloud(meta, get, theme, (name) => {
  scales[name] ??= new Scale(cloud_values(name), name !== "height");
  return scales[name];
});

/** @param {string} name */
function cloud_values(name) {
  return name === "height" ? get("point").filter((_, k) => k % 3 === 2) : get(`point-${name}`);
}

const picture = /** @type {HTMLImageElement|null} */ (document.getElementById("plan-picture"));

function recolour() {
  if (picture && picture.naturalWidth) {
    top_view.plan = tinted(picture, theme.rgb("plan-wall"), theme.rgb("plan-free"));
    cloud.setPlan(tinted(picture, [0.5, 0.56, 0.62], [0.13, 0.16, 0.19]));
  }
  top_view.ask();
}

/** A value of a layer in words. @param {string} name @param {number} value */
function words(name, value) {
  if (!Number.isFinite(value)) return "–";
  if (name === "count") return value.toFixed(0);
  return name === "turn" ? `${Number(value.toPrecision(2))}°` : length(own(value), units);
}

const heading = (/** @type {number} */ index) => `${Math.round(meta.grid.heading_deg[index])}°`;

/** @param {number|null} x @param {number|null} y @param {number} place */
function say(x, y, place) {
  const out = byId("readout");
  if (x === null || y === null) {
    setText(out, "Point at a place to read what a camera there would see.");
    return;
  }
  const unit = units === "m" ? " m" : "";
  let text = `x ${own(x).toFixed(2)}, y ${own(y).toFixed(2)}${unit}`;
  if (place >= 0) {
    const choice = top_view.choice === "rose" ? "worst" : top_view.choice;
    const of = layer.cell(top_view.name, place, choice);
    const k = place * layer.headings + Math.max(0, of.heading);
    const values = of.heading < 0 ? ["count", "sigma", "turn"].map((name) => layer.cell(name, place, "mean").value)
      : ["count", "sigma", "turn"].map((name) => layer.values[name][k]);
    const which = of.heading < 0 ? "mean of the headings" : `${choice === "worst" ? "worst heading" : "heading"} ${heading(of.heading)}`;
    text += `, ${own(layer.height[place]).toFixed(2)}${unit} high. ${which}: ${words("count", values[0])} landmarks, `;
    text += of.lost ? "would be lost" : `position ±${words("sigma", values[1])}, direction ±${words("turn", values[2])}`;
    text += `. Lost in ${of.lost_headings} of ${layer.headings} headings.`;
  }
  setText(out, text);
}

function legend() {
  const { name } = top_view;
  const scale = layer.scales[name];
  const is_low_good = name !== "count";
  drawRamp(canvasById("layer-ramp"), meta.ramp, false);
  setText(byId("layer-bad"), words(name, is_low_good ? scale.high : scale.low));
  setText(byId("layer-good"), words(name, is_low_good ? scale.low : scale.high));
  const shown = scales[cloud.colour];
  drawRamp(canvasById("cloud-ramp"), meta.vivid, false);
  const spoken = (/** @type {number} */ value) => (cloud.colour === "observations" ? value.toFixed(0) : cloud.colour === "height" ? `${(Math.round(10 * own(value)) / 10 + 0).toFixed(1)}${units === "m" ? " m" : " units"}` : length(own(value), units));
  if (!shown) return;
  setText(byId("cloud-low"), spoken(shown.low));
  setText(byId("cloud-high"), spoken(shown.high));
}

/** @param {string} id @param {(value: string) => void} act */
function onSelect(id, act) {
  byId(id).addEventListener("change", (event) => {
    act(/** @type {HTMLSelectElement} */ (event.target).value);
    legend();
    top_view.ask();
  });
}

onSelect("layer", (value) => (top_view.name = value));
onSelect("heading", (value) => (top_view.choice = value));
onSelect("cloud-colour", (value) => cloud.colourBy(value));
for (const box of /** @type {NodeListOf<HTMLInputElement>} */ (document.querySelectorAll("input[data-shows]"))) {
  box.addEventListener("change", () => {
    const of = box.dataset.of === "cloud" ? cloud : top_view;
    /** @type {Record<string, boolean>} */ (of.shows)[/** @type {string} */ (box.dataset.shows)] = box.checked;
    of.ask();
  });
}
byId("top-fit").addEventListener("click", () => top_view.fit());
byId("cloud-fit").addEventListener("click", () => cloud.fit());
top_view.pointed = say;
say(null, null, -1);
show(byId("no-script"), false);
if (picture && !picture.complete) picture.addEventListener("load", recolour);
recolour();
legend();
document.documentElement.dataset.ready = "yes";
