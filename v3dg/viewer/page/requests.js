// Requests pictures whenever the view or the settings have changed.

/** @typedef {import("./app.js").App} App */

/** The camera counts as resting if nothing has changed for this time. */
const REST_MS = 250;

export class Requests {
  /** Number of the last request, which its pictures repeat. */
  number = 0;
  /**
   * The last request as JSON, with which the next one is compared; null to request again.
   *
   * @type {string}
   */
  asked = null;
  /** Whether anything has changed in the last `REST_MS`. */
  isMoving = false;
  /** Time at which the present movement began, ms. */
  movedAt = 0;
  /** The timer that ends a movement. */
  restTimer = 0;

  /** @param {App} app */
  constructor(app) {
    this.app = app;
  }

  /** Forgets the last request, because the server may not know it or may have changed the scene. */
  reset() {
    this.asked = null;
  }

  /** Marks the picture that is shown as outdated, because the scene has changed. */
  expire() {
    this.reset();
    this.number += 1;
    this.app.picture.sayState();
  }

  /**
   * Requests a picture if the view or the settings differ from the last request.
   *
   * @param {number} now
   */
  update(now) {
    const { app } = this;
    const { message } = app.look;
    const text = JSON.stringify(message);
    if (text !== this.asked) {
      app.redraw(); // tries again until the request is sent
      if (!app.connection.isFree) return;
      this.number += 1;
      app.connection.send({ ...message, number: this.number });
      this.asked = text;
      this.move(now);
    }
    app.picture.sayState();
  }

  /** @param {number} now */
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
