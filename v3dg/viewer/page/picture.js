// The last picture. It is transformed to follow the camera until the next picture arrives.

import * as M from "./math.js";
import { element } from "./elements.js";

/** @typedef {import("./app.js").App} App */
/** @typedef {import("./protocol.js").Picture} PictureMessage */

/** Minimum time between two updates of the statistics for drafts. */
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
   * @param {PictureMessage} message
   * @param {ArrayBuffer} bytes A JPEG.
   */
  async show(message, bytes) {
    const { app } = this;
    // A further picture for an old request may still arrive after the camera has moved.
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

  /** Displays whether the picture is the final one of the last request. */
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

  /** Transforms the picture to where it would appear from the present camera. */
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
