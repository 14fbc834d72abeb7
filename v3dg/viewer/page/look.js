// What is asked for: the camera's view, the size of the picture, and the settings.

/** @typedef {import("./camera.js").Camera} Camera */
/** @typedef {import("./protocol.js").Look} LookMessage */
/** @typedef {import("./protocol.js").Settings} Settings */
/** @typedef {import("./protocol.js").Hello} Hello */

/** Most px of the picture for one px of the page. */
const MOST_PIXEL_RATIO = 2;

export class Look {
  /**
   * What the picture shows, and how finely; null until the server has said what it begins with.
   *
   * @type {Settings}
   */
  settings = null;
  /** Px of the picture for one px of the window, as a share of what the screen can show. */
  resolution = 1;
  /** Longest side of a picture, px. */
  mostPixels = 0;

  /**
   * @param {HTMLElement} stage The element that pictures fill.
   * @param {Camera} camera
   */
  constructor(stage, camera) {
    this.stage = stage;
    this.camera = camera;
  }

  /** @param {Hello} hello */
  begin(hello) {
    this.settings = structuredClone(hello.settings);
    this.mostPixels = hello.limits.picture_px;
  }

  /** Width over height. */
  get aspect() {
    return this.stage.clientWidth / this.stage.clientHeight;
  }

  get view() {
    return this.camera.view(this.aspect);
  }

  /** Width and height of the full picture, px. */
  get size() {
    const screenRatio = Math.min(window.devicePixelRatio || 1, MOST_PIXEL_RATIO);
    const ratio = screenRatio * this.resolution;
    const width = this.stage.clientWidth * ratio;
    const height = this.stage.clientHeight * ratio;
    const fit = Math.min(1, this.mostPixels / Math.max(width, height));
    const side = (/** @type {number} */ length) => Math.max(1, Math.round(length * fit));
    return /** @type {[number, number]} */ ([side(width), side(height)]);
  }

  /** @returns {LookMessage} */
  get message() {
    return { type: "look", view: this.view, size: this.size, settings: this.settings };
  }
}
