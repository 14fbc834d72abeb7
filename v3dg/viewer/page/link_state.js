// The part of the web page's address after `#`, which contains the camera and the
// settings.

import * as M from "./math.js";
import { colorOf, hexOf } from "./colors.js";
import { AXES, MODES, SPEED_BOUNDS, isMode } from "./camera.js";

/** @typedef {import("./app.js").App} App */
/** @typedef {import("./page.js").Quaternion} Quaternion */
/** @typedef {import("./page.js").Vector} Vector */
/** @typedef {import("./protocol.js").Settings} Settings */
/** @typedef {import("./protocol.js").Shows} Shows */
/** @typedef {Record<string, string | number>} Parts */

/** Limits of the field of view in degrees. */
const FOV_BOUNDS = [1, 170];
const RESOLUTION_BOUNDS = [0.1, 1];
/** Usual values, which a link omits. The settings have further defaults. */
const USUAL = { mode: MODES[0], speed: 1, resolution: 1 };

export class LinkState {
  /** @param {App} app */
  constructor(app) {
    this.app = app;
    window.addEventListener("hashchange", () => {
      if (location.hash !== this.hash) this.open(location.hash);
    });
  }

  /**
   * A link to the current view, beginning with `#`. It does not contain values that are
   * defaults.
   */
  get hash() {
    const { camera, look, places, greeting } = this.app;
    /** @type {Parts} */
    const parts = {
      at: textOf(camera.position),
      turn: textOf(camera.wxyz),
      focus: textOf(camera.focus),
      fov: Number(M.degrees(camera.fov_y).toPrecision(5)),
      up: places.upAxis ?? textOf(camera.up),
      mode: camera.mode,
      speed: Number(camera.speed.toPrecision(3)),
      ...partsOf(look.settings),
      resolution: look.resolution,
    };
    /** @type {Parts} */
    const usual = { ...USUAL, ...partsOf(greeting.defaults) };
    delete usual.tolerance; // always included in the link
    const said = Object.entries(parts).filter(([name, value]) => usual[name] !== value);
    return `#${said.map(([name, value]) => `${name}=${value}`).join("&")}`;
  }

  /** Updates the address of the web page to the current view. */
  write() {
    history.replaceState(null, "", this.hash);
  }

  async copy() {
    const url = location.href.split("#")[0] + this.hash;
    this.write();
    try {
      await navigator.clipboard.writeText(url);
      this.app.status.confirm("The link was copied to the clipboard.");
    } catch {
      // Browsers do not allow web pages without encryption to use the clipboard.
      this.app.status.confirm("The link is in the address bar.");
    }
  }

  /**
   * Applies a link. If a value is missing or invalid, the current one is kept.
   *
   * @param {string} hash
   * @param {"jump" | "fly"} manner How the camera moves to the view.
   */
  open(hash, manner = "jump") {
    const values = new LinkValues(hash);
    const { app } = this;
    app.camera.up = values.up() ?? app.camera.up;
    this.openView(values, manner);
    const mode = values.text("mode") ?? USUAL.mode;
    if (isMode(mode)) app.setMode(mode);
    this.openSettings(values);
    app.look.resolution = values.number("resolution", RESOLUTION_BOUNDS) ?? USUAL.resolution;
    app.camera.speed = values.number("speed", SPEED_BOUNDS) ?? USUAL.speed;
    app.sync();
  }

  /**
   * Applies the view of a link.
   *
   * @param {LinkValues} values
   * @param {"jump" | "fly"} manner How the camera moves to the view.
   */
  openView(values, manner) {
    const { camera } = this.app;
    const position = /** @type {Vector} */ (values.numbers("at", 3));
    const turn = /** @type {Quaternion} */ (values.numbers("turn", 4));
    if (!position || !turn || M.length(turn) <= 0.5) return;
    const focus = /** @type {Vector} */ (values.numbers("focus", 3));
    const fov = values.number("fov", FOV_BOUNDS);
    const fov_y = fov === null ? camera.fov_y : M.radians(fov);
    const view = { position, wxyz: M.unit(turn), fov_y };
    if (manner === "fly") {
      camera.flyTo(view, focus);
      return;
    }
    camera.put(view);
    camera.focus = focus ?? camera.focus;
  }

  /**
   * Applies the settings of a link.
   *
   * @param {LinkValues} values
   */
  openSettings(values) {
    const { settings } = this.app.look;
    const { defaults, limits } = this.app.greeting;
    const { level_colors, shows_cuts } = this.app.scene;
    const lastLevel = Math.max(level_colors.length - 1, 0);
    const budget = values.number("budget", limits.budget);
    const level = values.number("level", [0, lastLevel]) ?? defaults.min_level;
    settings.shows = this.modeOf(values) ?? settings.shows;
    settings.tolerance = values.number("tolerance", limits.tolerance) ?? settings.tolerance;
    settings.budget = budget === null ? null : Math.round(budget);
    settings.min_level = Math.round(level);
    settings.gain = values.number("gain", limits.gain) ?? defaults.gain;
    settings.fade = values.text("fade") === "0" ? null : defaults.fade;
    settings.background = colorOf(values.text("background") ?? hexOf(defaults.background));
    settings.split = values.number("split", [0, 1]) ?? defaults.split;
    if (settings.split && !shows_cuts) {
      settings.split = 0;
      this.app.status.warn("The link's split is not available with a pool on a GPU.");
    }
  }

  /**
   * Returns the mode in a link. Returns null if there is none, or if the scene does not
   * support it.
   *
   * @param {LinkValues} values
   * @returns {Shows | null}
   */
  modeOf(values) {
    const { modes } = this.app.scene;
    const shows = values.text("show") ?? this.app.greeting.defaults.shows;
    const mode = modes.find((name) => name === shows);
    if (!mode) {
      this.app.status.warn(
        `The link's mode ${shows} is not available here; ${modes.join(", ")} are.`,
      );
    }
    return mode ?? null;
  }
}

/** The values in a link, by name. A value that is missing or invalid is null. */
class LinkValues {
  /** @param {string} hash */
  constructor(hash) {
    this.values = new URLSearchParams(hash.replace(/^#/, ""));
  }

  /**
   * Returns a value as text.
   *
   * @param {string} name
   */
  text(name) {
    return this.values.get(name);
  }

  /**
   * Returns a value as a number.
   *
   * @param {string} name
   * @param {number[]} bounds The limits to which it is clamped.
   */
  number(name, [low, high]) {
    const text = this.text(name);
    if (!text) return null;
    const value = Number(text);
    return Number.isFinite(value) ? M.clamp(value, low, high) : null;
  }

  /**
   * Returns a value as numbers that are separated by commas.
   *
   * @param {string} name
   * @param {number} count The required number of them.
   */
  numbers(name, count) {
    const values = M.numbersOf(this.text(name) ?? "");
    return values.length === count && values.every(Number.isFinite) ? values : null;
  }

  /**
   * Returns the up direction. A link contains the name of an axis, or three numbers.
   */
  up() {
    const name = this.text("up");
    if (Object.hasOwn(AXES, name)) return AXES[/** @type {keyof AXES} */ (name)];
    return /** @type {Vector} */ (this.numbers("up", 3));
  }
}

/**
 * Returns the settings in the form in which links contain them.
 *
 * @param {Settings} settings
 * @returns {Parts}
 */
function partsOf(settings) {
  return {
    show: settings.shows,
    tolerance: settings.tolerance,
    budget: settings.budget ?? "",
    level: settings.min_level,
    gain: settings.gain,
    fade: settings.fade === null ? 0 : 1,
    split: settings.split,
    background: hexOf(settings.background).slice(1),
  };
}

/**
 * Returns numbers as text, separated by commas.
 *
 * @param {number[]} values
 */
function textOf(values) {
  return values.map((value) => Number(value.toPrecision(7))).join(",");
}
