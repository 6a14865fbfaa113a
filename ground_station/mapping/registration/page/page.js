/** The page's own script. What is true lives with the server: each answer is the whole state. */

const SNAP_PX = 12;
const STEPS = 400; // of the histogram of heights and of the range inputs
const byId = (id) => document.getElementById(id);
const metres = (value) => (value < 0.995 ? `${(100 * value).toFixed(1)} cm` : `${value.toFixed(2)} m`);

let state = null;
let points = new Float32Array();
let revision = -1;
let scaling = null; // clicks on the plan while its scale is set, else null
let busy = false;
const plan = new Image();

const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`);

function heightRange() {
  const { low, high } = state.up;
  const at = (id) => low + (Number(byId(id).value) / STEPS) * (high - low);
  return [at("low"), at("high")];
}

function drawMark(c, u, v, name, of, halo = "paper") {
  c.lineWidth = 2;
  c.strokeStyle = c.fillStyle = colour(of);
  c.beginPath();
  c.arc(u, v, 6, 0, 7);
  c.moveTo(u - 10, v);
  c.lineTo(u + 10, v);
  c.moveTo(u, v - 10);
  c.lineTo(u, v + 10);
  c.stroke();
  c.font = "bold 14px system-ui, sans-serif";
  c.lineWidth = 4;
  c.strokeStyle = colour(halo);
  // Beside the mark, on the side where there is room.
  const left = u + 12 + c.measureText(name).width > c.canvas.clientWidth;
  c.textAlign = left ? "right" : "left";
  c.strokeText(name, u + (left ? -9 : 9), v - 8);
  c.fillText(name, u + (left ? -9 : 9), v - 8);
}

const markOf = (pick) => (pick.used ? "accent" : "bad");

function drawMap(c, view) {
  const [low, high] = heightRange();
  c.fillStyle = colour("points");
  c.globalAlpha = points.length > 60000 ? 0.35 : 0.6;
  for (let k = 0; k < points.length; k += 3) {
    if (points[k + 2] < low || points[k + 2] > high) continue;
    const [u, v] = view.toScreen(points[k], points[k + 1]);
    c.fillRect(u - 0.9, v - 0.9, 1.8, 1.8);
  }
  c.globalAlpha = 0.8;
  c.fillStyle = colour("camera");
  for (const [x, y] of state.cameras) {
    const [u, v] = view.toScreen(x, y);
    c.fillRect(u - 1, v - 1, 2, 2);
  }
  c.globalAlpha = 1;
  for (const pick of state.picks) drawMark(c, ...view.toScreen(pick.map[0], pick.map[1]), pick.name, markOf(pick));
  const { pending } = state;
  if (pending?.map) {
    const [u, v] = view.toScreen(pending.map[0], pending.map[1]);
    drawMark(c, u, v, pending.name, "good");
    if (pending.offer) {
      const [x, y] = view.toScreen(...pending.offer.map);
      c.setLineDash([3, 3]);
      drawMark(c, x, y, `${pending.offer.what}?`, "camera");
      c.setLineDash([]);
    }
  }
  if (view.hover) {
    c.strokeStyle = colour("accent");
    c.lineWidth = 1;
    c.beginPath();
    c.arc(...view.hover, SNAP_PX, 0, 7);
    c.stroke();
  }
}

function toPlan(x, y, by = state.fit.to_plan) {
  const [a, b, d, e, u, v] = by;
  return [a * x + d * y + u, b * x + e * y + v];
}

function overlay(c, view, by, of, alpha) {
  const [low, high] = heightRange();
  c.fillStyle = colour(of);
  c.globalAlpha = alpha;
  for (let k = 0; k < points.length; k += 3) {
    if (points[k + 2] < low || points[k + 2] > high) continue;
    const [u, v] = view.toScreen(...toPlan(points[k], points[k + 1], by));
    c.fillRect(u - 0.8, v - 0.8, 1.6, 1.6);
  }
  c.globalAlpha = 1;
}

function drawPlan(c, view) {
  if (plan.naturalWidth) {
    const [u, v] = view.toScreen(-0.5, -0.5);
    c.imageSmoothingEnabled = view.scale < 2;
    c.drawImage(plan, u, v, plan.naturalWidth * view.scale, plan.naturalHeight * view.scale);
  }
  if (state.walls) {
    overlay(c, view, state.walls.before, "plan-bad", 0.25);
    overlay(c, view, state.walls.after, "plan-overlay", 0.6);
  } else if (state.fit && byId("overlay").checked) overlay(c, view, state.fit.to_plan, "plan-overlay", 0.5);
  for (const pick of state.picks) {
    const [u, v] = view.toScreen(...pick.plan_px);
    if (state.fit) {
      c.strokeStyle = colour("plan-bad");
      c.lineWidth = 2;
      c.beginPath();
      c.moveTo(u, v);
      c.lineTo(...view.toScreen(...toPlan(pick.map[0], pick.map[1])));
      c.stroke();
    }
    drawMark(c, u, v, pick.name, pick.used ? "plan-accent" : "plan-bad", "plan-paper");
  }
  for (const at of scaling ?? []) drawMark(c, ...view.toScreen(...at), "", "plan-bad", "plan-paper");
}

function drawHeights() {
  const canvas = byId("heights");
  const c = canvas.getContext("2d");
  const { clientWidth: width, clientHeight: height } = canvas;
  canvas.width = width * devicePixelRatio;
  canvas.height = height * devicePixelRatio;
  c.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, 0, 0);
  const { heights, low, high, level } = state.up;
  const most = Math.max(...heights, 1);
  const [from, to] = heightRange();
  heights.forEach((count, k) => {
    const at = low + ((k + 0.5) / heights.length) * (high - low);
    c.fillStyle = colour(at >= from && at <= to ? "overlay" : "line");
    const tall = (height - 14) * Math.sqrt(count / most);
    c.fillRect((k / heights.length) * width, height - tall, width / heights.length + 0.3, tall);
  });
  const x = ((level - low) / (high - low)) * width;
  c.fillStyle = colour("bad");
  c.fillRect(x - 1, 0, 2, height);
  c.font = "12px system-ui, sans-serif";
  c.textAlign = x < width / 2 ? "left" : "right";
  c.fillText(`${state.up.height_m} m`, x + (x < width / 2 ? 5 : -5), 11);
}

function bounds() {
  if (!points.length) return null;
  const axes = [0, 1].map((axis) => points.filter((_, k) => k % 3 === axis).sort());
  const at = (values, share) => values[Math.floor(share * (values.length - 1))];
  return [at(axes[0], 0.01), at(axes[1], 0.01), at(axes[0], 0.99), at(axes[1], 0.99)];
}

function clickMap(x, y) {
  const [low, high] = heightRange();
  ask("click", { x, y, radius: SNAP_PX / mapView.scale, low, high, offers: byId("offers").checked });
}

function clickPlan(u, v) {
  if (!scaling) {
    ask("place", { u, v });
    return;
  }
  if (scaling.length < 2) scaling.push([u, v]);
  byId("scale-form").hidden = scaling.length < 2;
  if (scaling.length === 2) byId("scale-length").focus();
  planView.dirty = true;
  say();
}

const mapView = new View("map", 1, bounds, drawMap, clickMap);
const planView = new View("plan", -1, () => state && [0, 0, state.plan.width_px, state.plan.height_px], drawPlan, clickPlan);

function repaint() {
  mapView.dirty = planView.dirty = true;
}

/** Asks for a change; the answer is the new state, or one line that says why not. */
async function ask(what, body) {
  if (busy || state?.saved) return;
  busy = true;
  document.body.dataset.busy = what;
  let refused = "";
  try {
    const answer = await fetch(what, { method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(body ?? {}) });
    const said = await answer.json();
    if (answer.ok) await take(said);
    else refused = said.detail;
  } catch {
    refused = "no answer: the program that serves this page has ended";
  }
  busy = false;
  delete document.body.dataset.busy;
  show(refused);
}

async function take(said) {
  state = said;
  if (state.revision === revision) return;
  revision = state.revision;
  points = new Float32Array(await (await fetch("points")).arrayBuffer());
  if (!mapView.touched) mapView.fit();
}

function row(pick) {
  const tr = document.createElement("tr");
  tr.className = pick.used ? "" : "out";
  tr.dataset.pick = pick.name;
  const cells = [pick.name, pick.residual_m === null ? "" : metres(pick.residual_m),
    pick.used ? (pick.held_out_m === null ? "" : metres(pick.held_out_m)) : "left out"];
  if (pick.disagrees_most) tr.title = "disagrees most: where the others put it is furthest off";
  if (pick.disagrees_most) cells[2] += " ◂ most";
  cells.forEach((text, k) => {
    const cell = document.createElement(k ? "td" : "th");
    cell.className = k ? "number" : "";
    cell.textContent = text;
    tr.append(cell);
  });
  const acts = document.createElement("td");
  acts.className = "number";
  for (const [what, text] of [["redo", "again"], ["delete", "delete"]]) {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = text;
    button.setAttribute("aria-label", `${text} ${pick.name}`);
    button.addEventListener("click", () => ask(what, { name: pick.name }));
    acts.append(button, " ");
  }
  tr.append(acts);
  return tr;
}

function facts() {
  const { fit } = state;
  if (!fit) return [];
  const held = fit.held_out_rms_m === undefined ? [] : [["held out, RMS", metres(fit.held_out_rms_m)]];
  return [
    ["picks used", `${fit.points} of ${fit.points_given}`],
    ["residual, RMS", metres(fit.residual_rms_m)],
    ...held,
    ["scale", `${fit.scale.toPrecision(5)} ± ${fit.scale_sigma_percent.toPrecision(2)} %`],
    ["error mid-map, 90 %", `within ${metres(fit.centre_90_percent_m)}`],
    ["error worst corner, 90 %", `within ${metres(fit.corner_90_percent_m)}`],
  ];
}

function hint() {
  if (state.saved) return "Saved: the map is registered. This page can be closed.";
  if (scaling) return scaling.length < 2 ? `Click two points of the plan, far apart: ${2 - scaling.length} to go` : "Type how far apart they are";
  if (state.plan.resolution_m === null) return "The plan has no scale yet: press “set its scale”";
  const { pending } = state;
  if (!pending) return "Click a place in the map that the plan shows, too: a corner, a pillar";
  if (pending.offer) return `Click place ${pending.name} on the plan, or press S to move it to the ${pending.offer.what}`;
  return pending.map ? `Now click place ${pending.name} on the plan` : `Click place ${pending.name} in the map`;
}

function say() {
  byId("hint").textContent = hint();
}

function sayOffer() {
  const offer = state.pending?.offer;
  byId("snap").hidden = !offer || state.saved;
  if (offer) byId("snap").textContent = `move to the ${offer.what} (S)`;
}

function wallsWords() {
  const { walls, picks } = state;
  if (!walls) return picks.length < 2 ? "Needs two rough picks, far apart." : "Begins at the picks; you decide on what it finds.";
  const found = `${Math.round(100 * walls.on_walls)} % of the landmarks on walls, ${metres(walls.residual_m)} off them (RMS); before, orange, ${metres(walls.start_residual_m)}.`;
  return walls.ambiguous ? `${found} Not to be taken: ${walls.ambiguous}.` : found;
}

function sayWalls() {
  byId("walls-words").textContent = wallsWords();
  byId("walls-fit").disabled = state.picks.length < 2 || state.plan.resolution_m === null || state.saved;
  byId("walls-accept").hidden = !state.walls || Boolean(state.walls.ambiguous);
  byId("walls-refuse").hidden = !state.walls;
}

function list(id, texts) {
  byId(id).replaceChildren(...texts.map((text) => Object.assign(document.createElement("li"), { textContent: text })));
}

function show(refused) {
  if (!state) return;
  const { up, plan: drawn } = state;
  byId("map-name").textContent = state.map.name;
  byId("map-words").textContent = `${state.map.landmarks} landmarks`;
  byId("plan-words").textContent = `${drawn.name}, ${drawn.resolution_m === null ? "no scale" : `${drawn.resolution_m.toPrecision(3)} m a pixel`}`;
  const waiting = state.picks.length < 3 ? "" : state.problem;
  const problem = byId("problem");
  problem.textContent = refused || (state.saved ? "Saved." : waiting);
  problem.hidden = !problem.textContent;
  problem.className = state.saved && !refused ? "good" : "";
  byId("picks").replaceChildren(...state.picks.map(row));
  byId("no-picks").hidden = state.picks.length > 0;
  byId("fit").replaceChildren(...facts().flatMap(([name, value]) => [
    Object.assign(document.createElement("dt"), { textContent: name }),
    Object.assign(document.createElement("dd"), { textContent: value }),
  ]));
  list("notes", [...state.notes, ...(state.fit?.notes ?? [])]);
  byId("up-source").replaceChildren(...up.sources.map((name) => new Option({ levels: "level structure", cameras: "the cameras", map: "the map's z" }[name], name, false, name === up.source)));
  const axis = up.direction.map((x) => x.toFixed(3)).join(", ");
  byId("up-words").textContent = `Up is (${axis}) in the map, ±${up.sigma_deg.toFixed(1)}°; the level is at ${up.level.toPrecision(3)} along it.`;
  byId("tilt-x").value = up.tilt_deg[0];
  byId("tilt-y").value = up.tilt_deg[1];
  byId("level-height").value = up.height_m;
  byId("save").disabled = !state.fit || state.saved;
  for (const control of document.querySelectorAll("aside input, aside select, aside td button, #plan-scale, #map-turn")) control.disabled = state.saved;
  drawHeights();
  sayOffer();
  sayWalls();
  say();
  repaint();
}

function askUp(level) {
  const of = byId("level-of").value;
  const known = { floor: null, ceiling: state.up.ceiling, clicked: state.up.level }[of];
  ask("upright", {
    source: byId("up-source").value, tilt_x_deg: Number(byId("tilt-x").value), tilt_y_deg: Number(byId("tilt-y").value),
    level: level ?? known, height_m: Number(byId("level-height").value),
  });
}

for (const id of ["up-source", "tilt-x", "tilt-y", "level-height", "level-of"]) byId(id).addEventListener("change", () => askUp());
byId("heights").addEventListener("click", (event) => {
  const { low, high } = state.up;
  byId("level-of").value = "clicked";
  askUp(low + (event.offsetX / byId("heights").clientWidth) * (high - low));
});
for (const id of ["low", "high"]) byId(id).addEventListener("input", () => { drawHeights(); repaint(); });
byId("overlay").addEventListener("change", repaint);
byId("walls-fit").addEventListener("click", () => {
  const [low, high] = heightRange();
  ask("walls", { low, high });
});
byId("walls-accept").addEventListener("click", () => ask("decide", { accept: true }));
byId("walls-refuse").addEventListener("click", () => ask("decide", { accept: false }));
byId("snap").addEventListener("click", () => ask("snap"));
document.addEventListener("keydown", (event) => {
  if (event.key.toLowerCase() === "s" && !event.target.matches("input, select") && !byId("snap").hidden) ask("snap");
});
byId("map-turn").addEventListener("click", async () => {
  mapView.touched = false;
  await ask("turn");
});
byId("map-fit").addEventListener("click", () => mapView.fit());
byId("plan-fit").addEventListener("click", () => planView.fit());
byId("plan-scale").addEventListener("click", () => { scaling = []; say(); repaint(); });
function endScaling() {
  scaling = null;
  byId("scale-form").hidden = true;
  say();
  repaint();
}
byId("scale-cancel").addEventListener("click", endScaling);
byId("scale-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  const [one, other] = scaling.map(([u, v]) => ({ u, v }));
  const length_m = Number(byId("scale-length").value);
  endScaling();
  await ask("scale", { one, other, length_m });
});
byId("save").addEventListener("click", () => ask("save"));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => show(""));
plan.addEventListener("load", () => { planView.fit(); });
plan.src = "plan.png";
(function frame() {
  mapView.paint();
  planView.paint();
  requestAnimationFrame(frame);
})();
fetch("state").then((answer) => answer.json()).then(take).then(() => { document.body.dataset.ready = "yes"; show(""); });
