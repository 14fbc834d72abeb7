// The frames of the browser. In each, movements advance, pictures are requested, and
// the web page is drawn.

import * as M from "./math.js";

/** @typedef {import("./app.js").App} App */

/**
 * Maximum time step in seconds. Without it, the camera would jump after the tab was
 * hidden.
 */
const MOST_FRAME_SECONDS = 0.1;
const LEAST_FRAME_SECONDS = 1e-3;
/**
 * If the browser needs longer than this for a frame, it has no GPU. The last picture
 * then follows the camera only every `SELDOM_MS`, because the server may use the same
 * CPU.
 */
const SLOW_FRAME_MS = 25;
const SELDOM_MS = 100;

export class Frames {
  /** Whether `draw` is scheduled for the next frame. */
  isDue = false;
  /** Whether a picture has arrived that has not been drawn yet. */
  hasNewPicture = false;
  /** Time of the last frame, ms. */
  last = 0;
  /** Time at which the last frame was scheduled, ms. */
  requestedAt = 0;
  /** Time at which the web page was last drawn, ms. */
  drawnAt = 0;
  /** Time that the browser needs for a frame with drawing, ms. */
  frameMs = 0;

  /** @param {App} app */
  constructor(app) {
    this.app = app;
  }

  /**
   * Draws the web page in the next frame. If the view or the settings have changed, a
   * picture is requested.
   */
  redraw() {
    if (this.isDue) return;
    this.isDue = true;
    this.requestedAt = performance.now();
    requestAnimationFrame((now) => this.draw(now));
  }

  /**
   * Draws a frame.
   *
   * @param {number} now Time of the frame, ms.
   */
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
   * Advances all movements. Returns whether the camera is moving.
   *
   * @param {number} now Time of the frame, ms.
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
   * Returns whether a slow browser should not draw the web page again yet.
   *
   * @param {number} now Time of the frame, ms.
   */
  isTooSoon(now) {
    const waited = now - Math.max(this.drawnAt, this.app.requests.movedAt);
    return this.frameMs > SLOW_FRAME_MS && !this.hasNewPicture && waited < SELDOM_MS;
  }
}
