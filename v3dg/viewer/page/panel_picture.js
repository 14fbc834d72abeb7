// The panel's folder "Picture", about the content and the quality of pictures.

import { colorOf, hexOf } from "./colors.js";
import { addButton, addCheckbox, addColor, addRow, addSelect, addSlider } from "./controls.js";
import { make } from "./elements.js";

/** @typedef {import("./app.js").App} App */
/** @typedef {import("./protocol.js").Shows} Shows */

/** Names of the display modes. */
const NAMES = /** @type {Record<Shows, string>} */ ({
  appearance: "Colour",
  level: "Level",
  cluster: "Cluster",
  error: "Error",
  residency: "Residency",
  depth: "Depth",
  alpha: "Alpha",
  count: "Gaussians per pixel",
  difference: "Difference to all gaussians",
});
/** Modes that are only useful if there are levels. */
const OF_LEVELS = /** @type {Shows[]} */ (["level", "error", "difference"]);
/** Ends of the sliders. A slider is longer if its setting is larger. */
const MOST_TOLERANCE = 32;
const LEAST_MILLIONS = 0.01;
const MOST_MILLIONS = 20;
/** The limit, in millions of gaussians, when it is switched on. */
const FIRST_MILLIONS = 2;

export class PictureFolder {
  /**
   * @param {App} app
   * @param {HTMLElement} parent
   */
  constructor(app, parent) {
    this.app = app;
    const numLevels = app.scene.level_colors.length;
    this.shows = this.addModes(parent, numLevels > 1);
    this.gain = this.addGain(parent);
    const levels = make("div", { hidden: numLevels <= 1 });
    parent.append(levels);
    this.tolerance = this.addTolerance(levels);
    this.isLimited = this.addLimit(levels);
    this.budget = this.addBudget(levels);
    this.minLevel = this.addMinLevel(levels, numLevels);
    this.fade = this.addFade(levels);
    this.split = this.addSplit(levels);
    this.isFrozen = this.addFreeze(levels);
    this.resolution = this.addResolution(parent);
    this.background = this.addBackground(parent);
    const save = () => app.path.save("picture");
    addButton(addRow(parent), "Save picture", save, "Save the picture at full quality as a .png");
  }

  get settings() {
    return this.app.look.settings;
  }

  sync() {
    const { app, settings } = this;
    this.shows.set(settings.shows);
    this.gain.set(settings.gain);
    this.gain.element.hidden = settings.shows !== "difference";
    this.tolerance.set(settings.tolerance);
    this.isLimited.set(settings.budget !== null);
    this.budget.element.hidden = settings.budget === null;
    if (settings.budget !== null) this.budget.set(settings.budget / 1e6);
    this.minLevel.set(settings.min_level);
    this.fade.set(settings.fade !== null);
    this.split.set(settings.split);
    this.split.element.hidden = !app.scene.shows_cuts;
    this.isFrozen.set(settings.frozen !== null);
    this.isFrozen.element.hidden = !app.scene.shows_cuts;
    this.resolution.set(100 * app.look.resolution);
    this.background.set(hexOf(settings.background));
  }

  /**
   * Adds the colour of the background.
   *
   * @param {HTMLElement} parent
   */
  addBackground(parent) {
    const title = "The colour behind the gaussians.";
    const state = { value: hexOf(this.settings.background), title };
    return addColor(parent, "Background", state, (color) => {
      this.app.change({ background: colorOf(color) });
    });
  }

  /**
   * Adds the list of display modes.
   *
   * @param {HTMLElement} parent
   * @param {boolean} hasLevels
   */
  addModes(parent, hasLevels) {
    const modes = /** @type {Shows[]} */ (Object.keys(NAMES)).filter((mode) => {
      const isThere = hasLevels || !OF_LEVELS.includes(mode);
      return isThere && this.app.scene.modes.includes(mode);
    });
    const options = modes.map((mode) => [mode, NAMES[mode]]);
    return addSelect(parent, "Show", { options, value: this.settings.shows }, (shows) => {
      this.app.change({ shows: /** @type {Shows} */ (shows) });
    });
  }

  /**
   * Adds the slider that amplifies differences.
   *
   * @param {HTMLElement} parent
   */
  addGain(parent) {
    const [low, high] = this.app.limits.gain;
    const range = { low, high, step: 1, value: this.settings.gain };
    return addSlider(parent, "Amplify", range, (gain) => this.app.change({ gain }));
  }

  /**
   * Adds the slider of the tolerance.
   *
   * @param {HTMLElement} parent
   */
  addTolerance(parent) {
    const value = this.settings.tolerance;
    const title =
      "Largest screen area that one gaussian of a coarser cluster may stand for; 0 draws all.";
    const range = { low: 0, high: Math.max(MOST_TOLERANCE, value), step: 0.25, value, title };
    return addSlider(parent, "Tolerance px²", range, (tolerance) => this.app.change({ tolerance }));
  }

  /**
   * Adds the checkbox that limits the number of gaussians.
   *
   * @param {HTMLElement} parent
   */
  addLimit(parent) {
    const title = "Raise the tolerance until at most this number of gaussians is selected.";
    const state = { value: this.settings.budget !== null, title };
    return addCheckbox(parent, "Limit gaussians", state, (isLimited) => {
      if (isLimited) this.app.change({ budget: 1e6 * FIRST_MILLIONS, tolerance: 0 });
      else this.app.change({ budget: null, tolerance: this.toleranceWithoutLimit });
    });
  }

  /**
   * The tolerance after the limit is removed. With a limit, it is usually 0, which
   * would draw all gaussians.
   */
  get toleranceWithoutLimit() {
    return this.settings.tolerance || this.app.greeting.defaults.tolerance;
  }

  /**
   * Adds the slider of the limit.
   *
   * @param {HTMLElement} parent
   */
  addBudget(parent) {
    const { budget } = this.settings;
    const value = budget === null ? FIRST_MILLIONS : budget / 1e6;
    const range = {
      low: Math.min(LEAST_MILLIONS, value),
      high: Math.max(MOST_MILLIONS, value),
      isLogarithmic: true,
      value,
    };
    return addSlider(parent, "Millions", range, (millions) => {
      this.app.change({ budget: Math.max(1, Math.round(1e6 * millions)) });
    });
  }

  /**
   * Adds the slider of the finest level.
   *
   * @param {HTMLElement} parent
   * @param {number} numLevels
   */
  addMinLevel(parent, numLevels) {
    const high = Math.max(numLevels - 1, 1);
    const range = { low: 0, high, step: 1, value: this.settings.min_level };
    return addSlider(parent, "Finest level", range, (level) => {
      this.app.change({ min_level: level });
    });
  }

  /**
   * Adds the checkbox of the fade.
   *
   * @param {HTMLElement} parent
   */
  addFade(parent) {
    const title = "Blend between levels, so that nothing pops while the camera moves.";
    const state = { value: this.settings.fade !== null, title };
    return addCheckbox(parent, "Fade", state, (isOn) => {
      this.app.change({ fade: isOn ? this.app.greeting.defaults.fade : null });
    });
  }

  /**
   * Adds the checkbox that compares with the full asset.
   *
   * @param {HTMLElement} parent
   */
  addSplit(parent) {
    const title = "Show all gaussians on the left and the cut on the right.";
    const range = { low: 0, high: 1, step: 0.01, value: this.settings.split, title };
    return addSlider(parent, "Split", range, (split) => this.app.change({ split }));
  }

  /**
   * Adds the checkbox that freezes the cut.
   *
   * @param {HTMLElement} parent
   */
  addFreeze(parent) {
    const title = "Keep the cut of this camera while you fly around.";
    const state = { value: this.settings.frozen !== null, title };
    return addCheckbox(parent, "Freeze the cut", state, (isOn) => {
      this.app.change({ frozen: isOn ? this.app.look.view : null });
    });
  }

  /**
   * Adds the slider of the resolution.
   *
   * @param {HTMLElement} parent
   */
  addResolution(parent) {
    const { look } = this.app;
    const title =
      "Resolution at rest, relative to the window. While the camera moves, it depends on the drawing speed.";
    const range = { low: 10, high: 100, step: 5, value: 100 * look.resolution, title };
    return addSlider(parent, "Resolution %", range, (percent) => {
      look.resolution = percent / 100;
      this.app.sync();
    });
  }
}
