// The browser's frames: what moves is moved on, a picture is asked for, and the page is drawn.

import * as M from "./math.js";

/** @typedef {import("./app.js").App} App */

/** A tab that was hidden does not leap. */
const MOST_FRAME_SECONDS = 0.1;
const LEAST_FRAME_SECONDS = 1e-3;
/**
 * If the browser itself takes longer than this for a frame, as it does without a GPU, the last
 * picture follows the camera only every `SELDOM_MS`: the server may be on the same cores.
 */
const SLOW_FRAME_MS = 25;
const SELDOM_MS = 100;

export class Frames {
  /** Whether the browser is going to call `draw`. */
  isDue = false;
  /** Whether a picture came that has not been drawn yet. */
  hasNewPicture = false;
  /** Time of the last frame, ms. */
  last = 0;
  /** When the last frame was asked for, ms. */
  requestedAt = 0;
  /** When the page was last drawn, ms. */
  drawnAt = 0;
  /** How long the browser takes for a frame in which it draws, ms. */
  frameMs = 0;

  /** @param {App} app */
  constructor(app) {
    this.app = app;
  }

  /** Draws the page in the next frame, and asks for a picture if another one is wanted. */
  redraw() {
    if (this.isDue) return;
    this.isDue = true;
    this.requestedAt = performance.now();
    requestAnimationFrame((now) => this.draw(now));
  }

  /** @param {number} now Time of the frame, ms. */
  draw(now) {
    const { app } = this;
    this.isDue = false;
    if (!app.scene) return;
    const passed = (now - this.last) / 1000;
    const seconds = M.clamp(passed, LEAST_FRAME_SECONDS, MOST_FRAME_SECONDS);
    if (this.last === this.drawnAt) {
      this.frameMs = Math.max(performance.now() - this.requestedAt, 0.9 * this.frameMs);
    }
    this.last = now;
    const isMoving = this.advance(now, seconds);
    if (isMoving) this.redraw();
    app.path.recordFrame(now);
    app.requests.update(now);
    if (this.isTooSoon(now)) {
      this.redraw();
      return;
    }
    this.hasNewPicture = false;
    this.drawnAt = now;
    app.picture.place();
    app.fileCameras.placePhotograph();
    app.overlay.draw();
  }

  /**
   * Moves the camera on; returns whether it moves by itself.
   *
   * @param {number} now
   * @param {number} seconds
   */
  advance(now, seconds) {
    const { app } = this;
    const isPushed = app.movement.advance(seconds);
    app.camera.advance(seconds);
    app.path.playFrame(now);
    return isPushed || app.camera.flight !== null || app.path.isPlaying;
  }

  /**
   * Whether the browser is too slow to draw the page again already.
   *
   * @param {number} now
   */
  isTooSoon(now) {
    const waited = now - Math.max(this.drawnAt, this.app.requests.movedAt);
    return this.frameMs > SLOW_FRAME_MS && !this.hasNewPicture && waited < SELDOM_MS;
  }
}
