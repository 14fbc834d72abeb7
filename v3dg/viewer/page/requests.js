// Asks for pictures, each time that what is looked at has changed.

/** @typedef {import("./app.js").App} App */

/** The camera rests when nothing has changed for so long. */
const REST_MS = 250;

export class Requests {
  /** Number of the last request, which its pictures bear. */
  number = 0;
  /**
   * The last request as JSON, which the next one is compared with; null to ask again.
   *
   * @type {string}
   */
  asked = null;
  /** Whether what is looked at has changed in the last `REST_MS`. */
  isMoving = false;
  /** When it began to change, ms. */
  movedAt = 0;
  /** The timer that ends the movement. */
  restTimer = 0;

  /** @param {App} app */
  constructor(app) {
    this.app = app;
  }

  /** Forgets what was asked for, because the server may not know it or has changed the scene. */
  reset() {
    this.asked = null;
  }

  /** Says that the picture that is shown is of a scene that has changed. */
  expire() {
    this.reset();
    this.number += 1;
    this.app.picture.sayState();
  }

  /**
   * Asks for a picture if another one is wanted than was asked for last.
   *
   * @param {number} now
   */
  update(now) {
    const { app } = this;
    const { message } = app.look;
    const text = JSON.stringify(message);
    if (text !== this.asked) {
      app.redraw(); // until it is sent
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
