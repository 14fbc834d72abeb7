// The last picture. Until the next picture arrives, it is transformed to follow the
// camera.

import * as M from "./math.js";
import { element } from "./elements.js";

/** @typedef {import("./app.js").App} App */
/** @typedef {import("./protocol.js").Picture} PictureMessage */

/** Minimum time between two updates of the statistics while drafts are shown. */
const FIGURES_MS = 200;

export class Picture {
  canvas = /** @type {HTMLCanvasElement} */ (element("picture"));
  context = this.canvas.getContext("bitmaprenderer");
  /**
   * The message of the picture that is shown; null before the first picture.
   *
   * @type {PictureMessage}
   */
  message = null;
  /** Time at which the statistics were last updated, ms. */
  figuresAt = -Infinity;

  /** @param {App} app */
  constructor(app) {
    this.app = app;
  }

  /**
   * Shows a picture.
   *
   * @param {PictureMessage} message The message of the picture.
   * @param {ArrayBuffer} bytes The picture as a JPEG.
   */
  async show(message, bytes) {
    const { app } = this;
    // Another picture for an old request may still arrive after the camera has moved.
    const isLate = message.number !== app.requests.number;
    if (isLate && message.number === this.message?.number) return;
    const bitmap = await createImageBitmap(new Blob([bytes], { type: "image/jpeg" }));
    const [width, height] = message.size;
    this.canvas.width = width;
    this.canvas.height = height;
    this.context.transferFromImageBitmap(bitmap);
    this.message = message;
    app.frames.hasNewPicture = true;
    app.camera.ahead = message.distance ?? app.camera.ahead;
    const now = performance.now();
    if (message.final || now - this.figuresAt >= FIGURES_MS) {
      app.panel.showFigures(message);
      this.figuresAt = now;
    }
    app.panel.showPace();
    this.sayState();
    app.redraw();
  }

  /** Shows whether the picture is the final one of the last request. */
  sayState() {
    if (!this.message) return;
    const { status, requests, look } = this.app;
    const [width, height] = this.message.size;
    const [fullWidth, fullHeight] = look.size;
    status.showRefined(Math.min(1, width / fullWidth));
    if (this.message.final && this.message.number === requests.number) {
      status.say("ready", `${width} × ${height}`);
      return;
    }
    const size = `${width} × ${height} of ${fullWidth} × ${fullHeight}`;
    if (requests.isMoving) status.say("moving", `draft, ${size}`);
    else status.say("refining", `refining, ${size}`);
  }

  /**
   * Transforms the picture to the position at which the current camera would see it.
   */
  place() {
    if (!this.message) return;
    const { camera, look } = this.app;
    const { view, distance } = this.message;
    let transform = null;
    if (!camera.isAt(view)) {
      const away = distance ?? camera.distance;
      const { clientWidth, clientHeight } = look.stage;
      transform = M.warp(view, look.view, away, clientWidth, clientHeight);
    }
    this.canvas.style.transform = transform ?? "none";
  }
}
