// @ts-check
/** Mouse, touch, wheel and keys of a view, as a few plain movements. */

/**
 * @typedef {object} Movements all in CSS pixels
 * @property {(dx: number, dy: number) => void} drag one finger or the first button
 * @property {(dx: number, dy: number) => void} shift two fingers, another button, or with Shift
 * @property {(factor: number, x: number, y: number) => void} zoom about a point
 * @property {() => void} reset
 * @property {(x: number, y: number) => void} [hover]
 * @property {() => void} [leave]
 */

const KEY_STEP_PX = 40;
const KEY_ZOOM = 1.25;

/**
 * @param {HTMLElement} element which takes the keyboard's focus @param {Movements} movements
 */
export function listen(element, movements) {
  /** @type {Map<number, {x: number, y: number}>} */
  const fingers = new Map();

  /** @param {PointerEvent|WheelEvent|MouseEvent} event */
  const place = (event) => ({ x: event.offsetX, y: event.offsetY });

  element.addEventListener("pointerdown", (event) => {
    element.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  element.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) {
      const { x, y } = place(event);
      movements.hover?.(x, y);
      return;
    }
    const now = { x: event.clientX, y: event.clientY };
    const dx = now.x - before.x;
    const dy = now.y - before.y;
    if (fingers.size === 1) {
      const other = event.shiftKey || (event.pointerType === "mouse" && !(event.buttons & 1));
      (other ? movements.shift : movements.drag)(dx, dy);
    } else if (fingers.size === 2) {
      const [still] = [...fingers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
      const apart = Math.hypot(before.x - still.x, before.y - still.y);
      const rect = element.getBoundingClientRect();
      const middle = { x: (now.x + still.x) / 2 - rect.left, y: (now.y + still.y) / 2 - rect.top };
      movements.shift(dx / 2, dy / 2);
      if (apart > 10) movements.zoom(Math.hypot(now.x - still.x, now.y - still.y) / apart, middle.x, middle.y);
    }
    fingers.set(event.pointerId, now);
  });
  for (const end of ["pointerup", "pointercancel", "lostpointercapture"]) {
    element.addEventListener(end, (event) => fingers.delete(/** @type {PointerEvent} */ (event).pointerId));
  }
  element.addEventListener("pointerleave", () => movements.leave?.());
  element.addEventListener("contextmenu", (event) => event.preventDefault());
  element.addEventListener("dblclick", () => movements.reset());
  element.addEventListener(
    "wheel",
    (event) => {
      event.preventDefault();
      const { x, y } = place(event);
      const lines = event.deltaMode === 1 ? 16 : 1;
      movements.zoom(Math.exp(-0.0015 * lines * Math.max(-300, Math.min(300, event.deltaY))), x, y);
    },
    { passive: false },
  );
  element.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    const middle = [element.clientWidth / 2, element.clientHeight / 2];
    const move = event.shiftKey ? movements.shift : movements.drag;
    /** @type {Record<string, () => void>} */
    const keys = {
      ArrowLeft: () => move(KEY_STEP_PX, 0),
      ArrowRight: () => move(-KEY_STEP_PX, 0),
      ArrowUp: () => move(0, KEY_STEP_PX),
      ArrowDown: () => move(0, -KEY_STEP_PX),
      "+": () => movements.zoom(KEY_ZOOM, middle[0], middle[1]),
      "=": () => movements.zoom(KEY_ZOOM, middle[0], middle[1]),
      "-": () => movements.zoom(1 / KEY_ZOOM, middle[0], middle[1]),
      0: () => movements.reset(),
    };
    const act = keys[event.key];
    if (!act) return;
    event.preventDefault();
    event.stopPropagation();
    act();
  });
}
