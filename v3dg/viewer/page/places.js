// Places for the camera: the whole scene, a point, an instance, or a camera of the
// file. Also the up axis.

import * as M from "./math.js";
import { AXES } from "./camera.js";

/** @typedef {import("./app.js").App} App */
/** @typedef {import("./page.js").Axis} Axis */
/** @typedef {import("./page.js").Pinhole} Pinhole */
/** @typedef {import("./page.js").Vector} Vector */

/** Directions count as equal if the cosine of the angle between them exceeds this value. */
const SAME_DIRECTION = 0.9999;
const HOME_FOV_Y = Math.PI / 4;
/** Angle above the horizon, in radians, for a view of the whole scene. */
const HOME_PITCH = 0.45;

export class Places {
  /** @param {App} app */
  constructor(app) {
    this.app = app;
  }

  /**
   * The up axis; null if the up direction is not a world axis.
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

  /** Turns the camera upright. */
  level() {
    this.app.camera.level();
    this.app.redraw();
  }

  /**
   * The first view of the scene. It shows an object completely, and a room from inside.
   *
   * @returns {Pinhole}
   */
  get home() {
    const { greeting, camera } = this.app;
    const isUpAsSaid = M.dot(M.unit(greeting.up), M.unit(camera.up)) > SAME_DIRECTION;
    return isUpAsSaid ? this.firstHome.view : this.homeFromAbove;
  }

  /** The point around which the camera of the first view orbits. */
  get homeFocus() {
    return this.home === this.firstHome.view ? this.firstHome.focus : this.app.scene.center;
  }

  /**
   * The first view for the widest window that is not wider than this window. If there
   * is none, the view for the narrowest window.
   */
  get firstHome() {
    const { homes } = this.app.scene;
    const fitting = homes.filter(({ view }) => view.aspect <= this.app.look.aspect);
    return fitting.at(-1) ?? homes[0];
  }

  /**
   * A view of the whole scene from slightly above, for an up axis that the user has
   * chosen.
   *
   * @returns {Pinhole}
   */
  get homeFromAbove() {
    const { scene, camera, look } = this.app;
    const side = M.unit(M.cross(camera.up, M.axisAcross(camera.up)));
    const level = M.mul(side, Math.cos(HOME_PITCH));
    const forward = M.add(level, M.mul(camera.up, -Math.sin(HOME_PITCH)));
    // If the window is higher than wide, the horizontal field of view is the smaller
    // one.
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
   * Flies to a place that the user has typed: x y z, # and the number of an instance,
   * or the name of a camera.
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

  /**
   * Flies to an instance.
   *
   * @param {number} instance The number of the instance.
   */
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
