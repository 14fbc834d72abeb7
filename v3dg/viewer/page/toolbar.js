// The buttons over the picture, and the button that opens and closes the panel.

import { AXES, isMode } from "./camera.js";
import { element, make } from "./elements.js";

/** @typedef {import("./app.js").App} App */
/** @typedef {import("./page.js").Axis} Axis */
/** @typedef {import("./page.js").Tool} Tool */

/**
 * Media query for windows in which the panel covers the picture. It is the same as in
 * style.css.
 */
const SMALL_WINDOW = "(max-width: 700px), (max-height: 480px)";

export class Toolbar {
  menu = element("menu");
  question = element("question");
  tools = element("tools");

  /** @param {App} app */
  constructor(app) {
    this.app = app;
    document.body.dataset.mode = app.camera.mode;
    this.addAxes();
    for (const button of buttons("#stage button")) {
      button.addEventListener("click", () => this.press(button.dataset));
    }
    this.menu.addEventListener("click", () => this.togglePanel());
    if (matchMedia(SMALL_WINDOW).matches) this.foldPanel();
  }

  /** Adds a button for each axis to the question about the up direction. */
  addAxes() {
    for (const axis of Object.keys(AXES)) {
      const attributes = { role: "radio", "data-up": axis, title: `${axis} is up` };
      this.question.lastElementChild.before(make("button", attributes, axis));
    }
  }

  /**
   * Executes the action of a button.
   *
   * @param {DOMStringMap} data The data attributes of the button.
   */
  press({ mode, tool, up, act }) {
    const { app } = this;
    if (isMode(mode)) app.setMode(mode);
    if (tool) app.instances.setTool(/** @type {Tool} */ (tool));
    if (up) {
      app.places.setUp(/** @type {Axis} */ (up));
      app.places.showAll();
    }
    switch (act) {
      case "undo":
        app.instances.undo();
        break;
      case "deselect":
        app.instances.select(null);
        break;
      case "dismiss":
        this.showQuestion(false);
        break;
    }
    app.sync();
  }

  /** Marks the mode, the tool and the axis that are chosen. */
  sync() {
    const { camera, instances, places } = this.app;
    check("mode", camera.mode);
    check("tool", instances.tool);
    check("up", places.upAxis);
    this.tools.hidden = !instances.selected;
  }

  /**
   * Shows or hides the question about the up direction.
   *
   * @param {boolean} isShown
   */
  showQuestion(isShown) {
    this.question.hidden = !isShown;
  }

  togglePanel() {
    const isFolded = document.body.classList.toggle("folded");
    this.menu.setAttribute("aria-expanded", String(!isFolded));
  }

  foldPanel() {
    document.body.classList.add("folded");
    this.menu.setAttribute("aria-expanded", "false");
  }
}

/**
 * Marks the one button whose attribute `data-…` has this value as chosen.
 *
 * @param {"mode" | "tool" | "up"} name
 * @param {string | null} value
 */
function check(name, value) {
  for (const button of buttons(`[role=radio][data-${name}]`)) {
    button.setAttribute("aria-checked", String(button.dataset[name] === value));
  }
}

/**
 * Returns the buttons that match a selector.
 *
 * @param {string} selector
 */
function buttons(selector) {
  return /** @type {NodeListOf<HTMLButtonElement>} */ (document.querySelectorAll(selector));
}
