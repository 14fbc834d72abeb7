// The request for a picture: the camera's view, the size of the picture, and the
// settings.

/** @typedef {import("./camera.js").Camera} Camera */
/** @typedef {import("./protocol.js").Look} LookMessage */
/** @typedef {import("./protocol.js").Settings} Settings */
/** @typedef {import("./protocol.js").Hello} Hello */

/** Maximum number of picture px for each px of the web page. */
const MOST_PIXEL_RATIO = 2;

export class Look {
  /**
   * The settings of the picture; null until the server has sent their initial values.
   *
   * @type {Settings}
   */
  settings = null;
  /** Resolution of the picture as a fraction of the resolution of the screen. */
  resolution = 1;
  /** Maximum length of the longer side of a picture, px. */
  mostPixels = 0;

  /**
   * @param {HTMLElement} stage The element that pictures fill.
   * @param {Camera} camera
   */
  constructor(stage, camera) {
    this.stage = stage;
    this.camera = camera;
  }

  /**
   * Takes the initial settings from the first message of the server.
   *
   * @param {Hello} hello
   */
  begin(hello) {
    this.settings = structuredClone(hello.settings);
    this.mostPixels = hello.limits.picture_px;
  }

  /** The width of the picture divided by its height. */
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

  /**
   * The message that requests a picture.
   *
   * @returns {LookMessage}
   */
  get message() {
    return { type: "look", view: this.view, size: this.size, settings: this.settings };
  }
}
