// The last picture that came, which follows the camera until the next one comes.

import * as M from "./math.js";
import { element } from "./elements.js";

/** @typedef {import("./app.js").App} App */
/** @typedef {import("./protocol.js").Picture} PictureMessage */

/** The figures of drafts change no more often than this. */
const FIGURES_MS = 200;

export class Picture {
  canvas = /** @type {HTMLCanvasElement} */ (element("picture"));
  context = this.canvas.getContext("bitmaprenderer");
  /**
   * What came with the picture that is shown; null before the first one.
   *
   * @type {PictureMessage}
   */
  message = null;
  /** When the figures were last shown, ms. */
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
    // A second picture for what is no longer looked at was under way when the camera moved.
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

  /** Says whether the picture is the one that was asked for last, and in full. */
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

  /** Puts the picture where it would be seen from the camera's present place. */
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
