// Requests pictures whenever the view or the settings have changed.

/** @typedef {import("./app.js").App} App */

/** The camera counts as resting if nothing has changed for this time. */
const REST_MS = 250;

export class Requests {
  /** Number of the last request. The server repeats it with each picture. */
  number = 0;
  /**
   * The last request as JSON, for comparison with the next one; null to request again.
   *
   * @type {string}
   */
  asked = null;
  /** Whether anything has changed during the last `REST_MS`. */
  isMoving = false;
  /** Time at which the current movement began, ms. */
  movedAt = 0;
  /** The timer that ends a movement. */
  restTimer = 0;

  /** @param {App} app */
  constructor(app) {
    this.app = app;
  }

  /**
   * Clears the last request, because the server may not have received it or may have
   * changed the scene.
   */
  reset() {
    this.asked = null;
  }

  /** Marks the current picture as outdated, because the scene has changed. */
  expire() {
    this.reset();
    this.number += 1;
    this.app.picture.sayState();
  }

  /**
   * Requests a picture if the view or the settings differ from the last request.
   *
   * @param {number} now Time of the frame, ms.
   */
  update(now) {
    const { app } = this;
    const { message } = app.look;
    const text = JSON.stringify(message);
    if (text !== this.asked) {
      app.redraw(); // try again until the request is sent
      if (!app.connection.isFree) return;
      this.number += 1;
      app.connection.send({ ...message, number: this.number });
      this.asked = text;
      this.move(now);
    }
    app.picture.sayState();
  }

  /**
   * Starts or continues a movement.
   *
   * @param {number} now Time of the frame, ms.
   */
  move(now) {
    if (!this.isMoving) this.movedAt = now;
    this.isMoving = true;
    clearTimeout(this.restTimer);
    this.restTimer = setTimeout(() => this.rest(), REST_MS);
  }

  rest() {
    const { app } = this;
    this.isMoving = false;
    if (!app.scene) return;
    app.linkState.write();
    app.panel.sync();
    app.redraw();
  }
}
