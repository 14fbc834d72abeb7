// A path of the camera. Its views are added or recorded, and can be played and saved.

import * as M from "./math.js";

/** @typedef {import("./app.js").App} App */
/** @typedef {import("./protocol.js").Play} Play */
/** @typedef {import("./protocol.js").Save} Save */
/** @typedef {import("./protocol.js").View} View */

const RECORDED_A_SECOND = 30;
/** Minimum time between two views, because the viewer does not accept equal times. */
const LEAST_SECONDS = 0.01;
/**
 * The name of the film size that equals the size of the window. All other names are
 * like "1280 x 720".
 */
export const AS_THE_WINDOW = "as the window";

export class CameraPath {
  /**
   * Views, each with the seconds since the previous view.
   */
  stops = [];
  /** Seconds between the last view and the next one that is added. */
  secondsOfNextStop = 2;
  /** Width and height of films, px, or `AS_THE_WINDOW`. */
  filmSize = "1280 x 720";
  isRecording = false;
  /**
   * Time at which a view was last recorded, ms; null before the first one.
   *
   * @type {number}
   */
  recordedAt = null;
  /**
   * The views that are being played, and the time at which playback started, ms; null
   * if nothing is played.
   *
   * @type {Play & { start: number }}
   */
  film = null;

  /** @param {App} app */
  constructor(app) {
    this.app = app;
  }

  /** Removes the path when another scene is opened. */
  reset() {
    this.stops = [];
  }

  get isPlaying() {
    return this.film !== null;
  }

  /** Duration from the first to the last view in seconds. */
  get duration() {
    return sumOfSeconds(this.stops.slice(1));
  }

  addStop() {
    if (this.isRecording) return;
    this.stops.push([this.secondsOfNextStop, this.app.look.view]);
    this.app.sync();
  }

  clear() {
    this.stops = [];
    this.isRecording = false;
    this.app.panel.showRecording(false);
    this.app.sync();
  }

  /** Removes the path, and starts recording views. */
  startRecording() {
    this.stops = [];
    this.recordedAt = null;
    this.isRecording = true;
    this.app.sync();
  }

  stopRecording() {
    this.record(performance.now()); // the path ends with the current view
    this.isRecording = false;
    this.app.sync();
  }

  /**
   * Records a view if enough time has passed.
   *
   * @param {number} now Time of a frame, ms.
   */
  recordFrame(now) {
    if (!this.isRecording) return;
    const isFirst = this.recordedAt === null;
    if (isFirst || now - this.recordedAt >= 1000 / RECORDED_A_SECOND) this.record(now);
  }

  /**
   * Records a view.
   *
   * @param {number} now Time of the view, ms.
   */
  record(now) {
    const { app } = this;
    const last = this.stops.at(-1);
    if (last && app.camera.isAt(last[1])) return;
    let seconds = LEAST_SECONDS;
    if (this.recordedAt !== null) {
      const passed = (now - this.recordedAt) / 1000;
      seconds = M.clamp(passed, LEAST_SECONDS, app.limits.path_seconds);
    }
    this.stops.push([seconds, app.look.view]);
    this.recordedAt = now;
  }

  /**
   * Starts playback of the path.
   *
   * @param {Play} message
   */
  play(message) {
    this.film = { ...message, start: performance.now() };
    this.app.redraw();
  }

  /**
   * Moves the camera along the path that is played.
   *
   * @param {number} now Time of a frame, ms.
   */
  playFrame(now) {
    if (!this.film) return;
    const { views, fps, start } = this.film;
    const end = views.length - 1;
    // The time of the frame may be slightly before the arrival of the message, so it is
    // clamped.
    const place = M.clamp(((now - start) / 1000) * fps, 0, end);
    this.app.camera.put(views[Math.floor(place)]);
    if (place >= end) this.film = null;
  }

  /** Stops playing and saving. */
  stop() {
    this.film = null;
    this.app.connection.send({ type: "stop" });
  }

  /**
   * Requests a file of the picture, the scene or the path, or the views of the path for
   * playback.
   *
   * @param {Save["what"]} what
   */
  save(what) {
    const { app } = this;
    const most = app.limits.path_seconds;
    if (sumOfSeconds(this.stops) > most) {
      app.status.warn(`Path: expected at most ${most / 60} minutes, got more; clear the path`);
      return;
    }
    const look = structuredClone(app.look.message);
    if (what === "film" && this.filmSize !== AS_THE_WINDOW) {
      const [width, height] = this.filmSize.split(" x ").map(Number);
      look.size = [width, height];
    }
    app.connection.send({ type: "save", what, look, up: app.places.upAxis, path: this.stops });
  }
}

/**
 * Returns the seconds from the first to the last view.
 *
 * @param {[number, View][]} stops
 */
function sumOfSeconds(stops) {
  return stops.reduce((sum, [seconds]) => sum + seconds, 0);
}
