// @ts-check
/** Puts the page together: messages go to the store, the store tells the loop, the loop draws. */
import { Actions } from "./actions.js";
import { Alarms } from "./alarms.js";
import * as api from "./api.js";
import { StationClock } from "./clock.js";
import { Connection } from "./connection.js";
import { MapDialog, PowerDialog } from "./dialogs.js";
import { byId, setText } from "./dom.js";
import { Keyboard } from "./keyboard.js";
import { Layout } from "./layout.js";
import { Loop } from "./loop.js";
import { Maps } from "./maps.js";
import { Plan } from "./plan.js";
import { Playback } from "./playback.js";
import { body } from "./protocol.js";
import { RecordingsDialog } from "./recordings.js";
import { Scene } from "./scene.js";
import { Steps } from "./steps.js";
import { Status } from "./status.js";
import { Store } from "./store.js";
import { Theme } from "./theme.js";
import { Video } from "./video.js";

const TICK_MS = 250;
const SAMPLE_MS = 500;

const loop = new Loop();
const clock = new StationClock();
const store = new Store(clock, (topic) => loop.mark(topic));
const theme = new Theme(recoloured);

function recoloured() {
  plan.recolour();
  scene.setMap(plan.map, plan.bitmap);
}

/** @param {Record<string, any>} message */
function send(message) {
  return connection.send(message);
}

/** @param {string} id */
function choose(id) {
  if (!store.payloads.has(id) || id === store.selected) return;
  store.select(id);
  send({ type: "select", payload: id });
}

const plan = new Plan(store, loop, theme);
const scene = new Scene(store, loop, theme);
const video = new Video(store, loop, theme, send);
const alarms = new Alarms(store, loop);
const mapDialog = new MapDialog(store);
const powerDialog = new PowerDialog(store);
const playback = new Playback(store, send, () => {
  store.clear();
  video.clear();
  connection.reopen();
});
const recordings = new RecordingsDialog(
  (file, station) => playback.open(file, station),
  () => store.otherStations(),
);
const steps = new Steps(store, loop);
const actions = new Actions(store, loop, { map: () => mapDialog.open(), power: () => powerDialog.open() });
new Layout(() => {
  theme.read();
  recoloured();
});
new Status(store, loop, choose);

/**
 * A panel is its markup in `index.html` with `data-panel`, and the module of that name.
 * @type {{ sample?: () => void, clear?: () => void }[]}
 */
const panels = [];
for (const { dataset } of /** @type {NodeListOf<HTMLElement>} */ (document.querySelectorAll("[data-panel]"))) {
  import(`./${dataset.panel}.js`).then(({ Panel }) => panels.push(new Panel({ store, loop, theme, video })));
}

mapDialog.chosen = (name) => actions.ofPayload("map", `Map ${name}`, (id) => api.chooseMap(id, name));
mapDialog.sent = (name) => actions.ofPayload("map", name ? `Station ${name}` : "Whichever station", (id) => api.chooseStation(id, name));
powerDialog.confirmed = (id, command) =>
  actions.run("power", `${command === "reboot" ? "Restart" : "Shut down"} ${id}`, () => api.command(id, command));

const maps = new Maps((map, problem) => {
  plan.setMap(map, problem);
  scene.setMap(map, plan.bitmap);
  const facts = map ? `${map.name} · ${map.landmarks.length / 3} landmarks` : "";
  setText(byId("map-name"), facts);
});
loop.add(["estimate", "station", "selection"], () => maps.want(store.current?.estimate?.map || store.station.map || ""), 250);
loop.add(["selection"], () => {
  video.clear();
  for (const panel of panels) panel.clear?.();
});

/** @type {Record<string, (message: Record<string, any>) => void>} */
const takes = {
  hello: (message) => {
    clock.hello(message.now_ns);
    if (message.tape) {
      store.clear();
      store.select(message.payload ?? "");
    }
    playback.take(message.tape);
    store.take(body(message, "state"));
    if (!store.selected && message.payload) store.select(message.payload);
    if (store.selected && store.selected !== message.payload) send({ type: "select", payload: store.selected });
    video.ask();
    maps.again();
  },
  state: (message) => {
    if (message.playback) clock.hello(message.now_ns); // it stands still, or runs faster
    store.take(body(message));
    playback.show(message.playback);
  },
  estimate: (message) => store.takeEstimate(message.payload, body(message)),
  event: (message) => store.takeEvents([body(message)]),
  recording: (message) => store.takeRecording(body(message)),
  gone: (message) => store.takeGone(message.payload),
  selected: (message) => message.payload && store.select(message.payload),
  pong: (message) => clock.pong(message.sent_ms, message.now_ns),
  alarm: (message) => {
    const others = store.alarms.filter((alarm) => alarm.id !== message.alarm?.id);
    store.takeAlarms(message.active ? [...others, message.alarm] : others);
  },
};

const connection = new Connection({
  url: () => {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const query = store.selected ? `?payload=${encodeURIComponent(store.selected)}` : "";
    return `${scheme}://${location.host}${playback.path || `/api/live${query}`}`;
  },
  message: (message) => takes[message.type]?.(message),
  video: (header, jpeg) => video.take(header, jpeg),
  status: (status) => {
    store.link = status;
    if (status.phase === "waiting" && playback.file) {
      const why = status.reason || "the connection was lost";
      actions.say("refused", `${playback.file}: not played: ${why}`, 12_000);
      playback.leave();
    }
    if (status.phase === "refused") location.assign("/login");
    // A handshake that is refused looks to a page like a broken network.
    if (status.phase === "waiting") api.isSignedOut().then((is) => is && location.assign("/login"));
    loop.mark("connection");
    loop.mark("payload");
  },
});
byId("retry").addEventListener("click", () => connection.retryNow());

new Keyboard(
  [
    { key: "r", does: "Start or stop recording on the ground station", act: () => actions.buttons.record.node.click() },
    { key: "p", does: "Start or stop recording on the payload", act: () => actions.buttons["payload-record"].node.click() },
    { key: "l", does: "Relocalize", act: () => actions.buttons.relocalize.node.click() },
    { key: "m", does: "Choose a map", act: () => actions.buttons.map.node.click() },
    { key: "n", does: "Steps from payload to flight", act: () => steps.open() },
    { key: "g", does: "Recordings", act: () => recordings.open() },
    { key: " ", does: "Play or pause a recording", act: () => playback.toggle() },
    { key: "i", does: "Refresh the picture (key frame)", act: () => actions.buttons.idr.node.click() },
    { key: "a", does: "Acknowledge all alarms", act: () => alarms.acknowledgeAll() },
    { key: "s", does: "Alarm sound on or off", act: () => alarms.turnSound() },
    { key: "v", does: "Live video on or off", act: () => video.turn(!video.is_on) },
    { key: "f", does: "Follow the blimp on the floor plan", act: () => plan.follow(!plan.is_following) },
    { key: "+", does: "Zoom in on the floor plan", act: () => plan.zoomBy(1.4) },
    { key: "-", does: "Zoom out", act: () => plan.zoomBy(1 / 1.4) },
    { key: "0", does: "Show the whole map", act: () => plan.fit() },
    { key: "↑ ↓ ← →", does: "Move a view that has the focus, in 3D: turn" },
  ],
  (digit) => choose([...store.payloads.keys()][digit - 1] ?? ""),
);

setInterval(() => {
  loop.mark("tick");
  if (!store.isLive(store.current)) loop.mark("stale");
}, TICK_MS);
setInterval(() => {
  for (const panel of panels) panel.sample?.();
  loop.mark("sample");
}, SAMPLE_MS);
connection.open();
