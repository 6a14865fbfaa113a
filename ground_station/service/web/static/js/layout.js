// @ts-check
/** Where views and values lie and which colours the page has: chosen here, and remembered. */
import { byId, setAttribute } from "./dom.js";
import { recall, remember } from "./remembered.js";

const [MAIN, ORDER, SCHEME] = ["blimp.main-view", "blimp.values", "blimp.colours"];
const SYSTEM_DARK = "(prefers-color-scheme: dark)";

export class Layout {
  /** @param {() => void} recoloured */
  constructor(recoloured) {
    this.recoloured = recoloured;
    this.views = [.../** @type {NodeListOf<HTMLElement>} */ (document.querySelectorAll("[data-place]"))];
    for (const view of this.views) {
      view.querySelector('[data-do="swap"]')?.addEventListener("click", () => this.enlarge(view));
      view.querySelector('[data-do="full"]')?.addEventListener("click", () => fill(view));
    }
    this.values = [.../** @type {NodeListOf<HTMLElement>} */ (document.querySelectorAll(".rail > [id]"))];
    for (const name of recall(ORDER).split(" ")) this.values.find((value) => value.id === name)?.parentElement?.append(byId(name));
    for (const value of this.values) value.querySelector('[data-do="up"]')?.addEventListener("click", () => this.lift(value));
    document.body.classList.toggle("unfillable", !document.fullscreenEnabled);
    this.schemes = [.../** @type {NodeListOf<HTMLElement>} */ (byId("schemes").querySelectorAll("button"))];
    for (const button of this.schemes) button.addEventListener("click", () => this.colour(button.dataset.scheme ?? ""));
    const kept = this.views.find((view) => view.classList.contains(recall(MAIN)));
    if (kept) this.enlarge(kept);
    byId("dark").addEventListener("load", recoloured); // what does not apply is loaded last
    this.colour(recall(SCHEME));
  }

  /** Trades places with the large view. @param {HTMLElement} view */
  enlarge(view) {
    const large = this.views.find((one) => one.dataset.place === "main");
    if (!large || large === view) return;
    [large.dataset.place, view.dataset.place] = [view.dataset.place, large.dataset.place];
    remember(MAIN, view.classList[1]);
  }

  /** One place up; the first one goes to the end. @param {HTMLElement} value */
  lift(value) {
    const above = value.previousElementSibling;
    if (above?.id) above.before(value);
    else value.parentElement?.append(value);
    /** @type {HTMLElement} */ (value.querySelector('[data-do="up"]')).focus(); // which is lost in moving
    remember(ORDER, [.../** @type {HTMLElement} */ (value.parentElement).children].map((one) => one.id).join(" ").trim());
  }

  /** @param {string} scheme light, dark, or as the system has it */
  colour(scheme) {
    const known = scheme === "light" || scheme === "dark" ? scheme : "";
    /** @type {HTMLLinkElement} */ (byId("dark")).media = { light: "not all", dark: "all" }[known] ?? SYSTEM_DARK;
    setAttribute(byId("scheme"), "content", known || "light dark");
    for (const button of this.schemes) setAttribute(button, "aria-pressed", String(button.dataset.scheme === known));
    remember(SCHEME, known);
    this.recoloured();
  }
}

/** @param {HTMLElement} view */
function fill(view) {
  if (document.fullscreenElement) document.exitFullscreen();
  else view.requestFullscreen();
}
