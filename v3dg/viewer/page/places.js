// Where the camera can go: the whole scene, a point, an instance, a camera; and what is up.

import * as M from "./math.js";
import { AXES } from "./camera.js";

/** @typedef {import("./app.js").App} App */
/** @typedef {import("./page.js").Axis} Axis */
/** @typedef {import("./page.js").Pinhole} Pinhole */
/** @typedef {import("./page.js").Vector} Vector */

/** Cosine of the angle below which two directions are the same. */
const SAME_DIRECTION = 0.9999;
const HOME_FOV_Y = Math.PI / 4;
/** Angle to the horizon at which the whole scene is looked at, radians. */
const HOME_PITCH = 0.45;

export class Places {
  /** @param {App} app */
  constructor(app) {
    this.app = app;
  }

  /**
   * The axis that is up; null if it is none of the world's.
   *
   * @returns {Axis | null}
   */
  get upAxis() {
    const up = M.unit(this.app.camera.up);
    const names = /** @type {Axis[]} */ (Object.keys(AXES));
    return names.find((name) => M.dot(AXES[name], up) > SAME_DIRECTION) ?? null;
  }

  /** @param {Axis} axis */
  setUp(axis) {
    this.app.camera.up = AXES[axis];
    this.app.camera.level();
    this.app.sync();
  }

  /** Stands upright again. */
  level() {
    this.app.camera.level();
    this.app.redraw();
  }

  /**
   * The first view of the scene: all of an object, a room from inside.
   *
   * @returns {Pinhole}
   */
  get home() {
    const { greeting, camera } = this.app;
    const isUpAsSaid = M.dot(M.unit(greeting.up), M.unit(camera.up)) > SAME_DIRECTION;
    return isUpAsSaid ? this.firstHome.view : this.homeFromAbove;
  }

  /** The point that orbits go around at first. */
  get homeFocus() {
    return this.home === this.firstHome.view ? this.firstHome.focus : this.app.scene.center;
  }

  /** The widest first view that fits into the window, else the narrowest one. */
  get firstHome() {
    const { homes } = this.app.scene;
    const fitting = homes.filter(({ view }) => view.aspect <= this.app.look.aspect);
    return fitting.at(-1) ?? homes[0];
  }

  /**
   * A view of all of the scene, from a little above, for an axis that a person chose.
   *
   * @returns {Pinhole}
   */
  get homeFromAbove() {
    const { scene, camera, look } = this.app;
    const side = M.unit(M.cross(camera.up, M.axisAcross(camera.up)));
    const level = M.mul(side, Math.cos(HOME_PITCH));
    const forward = M.add(level, M.mul(camera.up, -Math.sin(HOME_PITCH)));
    // A window that is higher than wide shows less at its sides.
    const half = Math.atan(Math.tan(HOME_FOV_Y / 2) * Math.min(1, look.aspect));
    const distance = (0.95 * scene.radius) / Math.sin(half);
    const position = M.sub(scene.center, M.mul(forward, distance));
    return { wxyz: M.looking(forward, camera.up), position, fov_y: HOME_FOV_Y };
  }

  showAll() {
    this.app.camera.flyTo(this.home, this.homeFocus);
    this.app.redraw();
  }

  /**
   * Flies to what a person wrote: x y z, # and an instance's number, or a camera's name.
   *
   * @param {string} text
   */
  goTo(text) {
    const { app } = this;
    const name = text.trim();
    const index = app.fileCameras.indexOf(name);
    const point = M.numbersOf(name);
    if (index >= 0) {
      app.fileCameras.lookThrough(index);
    } else if (/^#\d+$/.test(name)) {
      this.goToInstance(Number(name.slice(1)));
    } else if (point.length === 3 && point.every(Number.isFinite)) {
      const distance = Math.min(app.camera.distance, 0.25 * app.scene.radius);
      app.camera.lookAt(/** @type {Vector} */ (point), distance);
      app.redraw();
    } else {
      const expected = "x y z, #instance or a camera's name";
      app.status.warn(`Go to: expected ${expected}, got ${name || "nothing"}`);
    }
  }

  /** @param {number} instance */
  goToInstance(instance) {
    const { app } = this;
    const last = app.scene.instances - 1;
    if (instance > last) {
      app.status.warn(`Go to: expected #0 to #${last}, got #${instance}`);
      return;
    }
    app.instances.flyTo(instance);
  }
}
