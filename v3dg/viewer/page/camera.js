// The camera of the page, and its movements. Lengths are in world units.

import * as M from "./math.js";

/** @typedef {import("./page.js").Axis} Axis */
/** @typedef {import("./page.js").Mode} Mode */
/** @typedef {import("./page.js").Pinhole} Pinhole */
/** @typedef {import("./page.js").Quaternion} Quaternion */
/** @typedef {import("./page.js").Vector} Vector */
/** @typedef {Pinhole & { focus: Vector }} FlightEnd */

/** @type {Record<Axis, Vector>} */
export const AXES = {
  x: [1, 0, 0],
  y: [0, 1, 0],
  z: [0, 0, 1],
  "-x": [-1, 0, 0],
  "-y": [0, -1, 0],
  "-z": [0, 0, -1],
};
/** @type {Mode[]} */
export const MODES = ["orbit", "fly", "walk"];
export const SPEED_BOUNDS = [0.01, 100];
const FLIGHT_SECONDS = 0.6;
/** Largest sine of the angle between the viewing direction and the horizon. */
const STEEPEST = 0.998;
/** Time constant in seconds with which the velocity approaches the requested one. */
const EASE_SECONDS = 0.07;

/**
 * Returns whether a text is the name of a mode.
 * @param {string} text
 * @returns {text is Mode}
 */
export function isMode(text) {
  return MODES.some((mode) => mode === text);
}

export class Camera {
  /** @type {Vector} */
  position = [0, -3, 1];
  /** Rotation from the camera's axes (x right, y down, z forward) to the world. */
  wxyz = M.looking([0, 3, -1], [0, 0, 1]);
  /** Vertical field of view, radians. */
  fov_y = Math.PI / 4;
  /** @type {Vector} The point that the camera orbits. */
  focus = [0, 0, 0];
  /** @type {Vector} */
  up = [0, 0, 1];
  /** @type {Mode} */
  mode = MODES[0];
  /** Factor by which the user changes the speed. At 1, it suits the scene. */
  speed = 1;
  /** Radius of the scene. */
  radius = 1;
  /**
   * Distance to the object in the middle of the picture; null if it is unknown.
   * @type {number}
   */
  ahead = null;
  /** @type {Vector} */
  velocity = [0, 0, 0];
  /** Time in seconds for which the user has kept moving towards a near object. */
  pushedSeconds = 0;
  /**
   * The current flight to another view, with the seconds since its start; null if there
   * is none.
   * @type {{ from: FlightEnd, to: FlightEnd, seconds: number }}
   */
  flight = null;

  get right() {
    return M.rotate(this.wxyz, [1, 0, 0]);
  }

  get down() {
    return M.rotate(this.wxyz, [0, 1, 0]);
  }

  get forward() {
    return M.rotate(this.wxyz, [0, 0, 1]);
  }

  /** Distance to the focus. */
  get distance() {
    return Math.max(M.length(M.sub(this.focus, this.position)), 1e-4 * this.radius);
  }

  /**
   * Speed in world units per second. It depends on the scene's size, and is lower near
   * objects.
   */
  get pace() {
    const near = this.ahead ?? this.radius;
    return this.speed * M.clamp(0.6 * near, this.leastPace, 0.6 * this.radius);
  }

  /**
   * Minimum speed near objects. It starts low, and rises while the user keeps moving.
   */
  get leastPace() {
    return 0.02 * this.radius * M.clamp(2 ** (2 * (this.pushedSeconds - 0.5)), 1, 10);
  }

  /**
   * Returns the camera's view, for a picture of this aspect ratio.
   * @param {number} aspect
   */
  view(aspect) {
    return { wxyz: this.wxyz, position: this.position, fov_y: this.fov_y, aspect };
  }

  /**
   * Returns whether a view equals the camera's view, except for rounding.
   * @param {Pinhole} view
   */
  isAt(view) {
    const size = this.radius + M.length(this.position);
    const isTurned = M.isNear(view.wxyz, this.wxyz, 1e-9);
    const isThere = M.isNear(view.position, this.position, 1e-9 * size);
    return isTurned && isThere && Math.abs(view.fov_y - this.fov_y) < 1e-9;
  }

  /**
   * Sets the factor of the speed, within its limits.
   * @param {number} speed
   */
  setSpeed(speed) {
    const [slowest, fastest] = SPEED_BOUNDS;
    this.speed = M.clamp(speed, slowest, fastest);
  }

  /**
   * Turns the camera by a yaw around the up axis and a pitch around the horizontal
   * axis. In orbit mode, the camera moves around the focus.
   * @param {number} yaw In radians.
   * @param {number} pitch In radians.
   */
  turn(yaw, pitch) {
    this.flight = null;
    this.rotate(M.about(this.up, yaw));
    const before = M.dot(this.forward, this.up);
    const rotation = M.about(this.right, pitch);
    const after = M.dot(M.rotate(rotation, this.forward), this.up);
    const isSteep = Math.abs(after) >= STEEPEST && Math.abs(after) >= Math.abs(before);
    if (!isSteep) this.rotate(rotation);
    if (this.mode !== "orbit") this.carryFocus();
  }

  /**
   * Turns the camera by a rotation in world space: around the focus in orbit mode, and
   * around its own position otherwise.
   * @param {Quaternion} rotation
   */
  rotate(rotation) {
    const pivot = this.mode === "orbit" ? this.focus : this.position;
    this.wxyz = M.unit(M.product(rotation, this.wxyz));
    this.position = M.add(pivot, M.rotate(rotation, M.sub(this.position, pivot)));
  }

  /** Places the focus in front of the camera, at the same distance as before. */
  carryFocus() {
    this.focus = M.add(this.position, M.mul(this.forward, this.distance));
  }

  /**
   * Moves by distances along the camera's axes.
   * @param {number} right
   * @param {number} down
   * @param {number} forward
   */
  shift(right, down, forward) {
    this.flight = null;
    const sideways = M.add(M.mul(this.right, right), M.mul(this.down, down));
    this.moveBy(M.add(sideways, M.mul(this.forward, forward)));
  }

  /**
   * Moves the camera by a vector.
   * @param {Vector} step The vector in world coordinates.
   */
  moveBy(step) {
    this.position = M.add(this.position, step);
    this.focus = M.add(this.focus, step);
  }

  /**
   * Multiplies the distance to the focus by a factor. If the camera reaches the focus,
   * the focus is moved ahead.
   * @param {number} factor The factor of the distance.
   */
  approach(factor) {
    this.flight = null;
    const least = 0.02 * this.radius;
    if (factor < 1 && this.distance * factor < least) {
      this.shift(0, 0, this.distance * (1 - factor));
      return;
    }
    const away = M.sub(this.position, this.focus);
    this.position = M.add(this.focus, M.mul(away, factor));
  }

  /** The directions in which the camera moves to the right, up and forward. */
  get pushDirections() {
    if (this.mode === "walk") return [this.right, this.up, M.unit(M.cross(this.up, this.right))];
    if (this.mode === "fly") return [this.right, M.mul(this.down, -1), this.forward];
    return [this.right, this.up, this.forward];
  }

  /**
   * Moves the camera for some time.
   * @param {Vector} push Movement to the right, up and forward; each is -1 to 1.
   * @param {number} seconds
   */
  move(push, seconds) {
    const isNear = 0.6 * (this.ahead ?? this.radius) < 0.05 * this.radius;
    const isPushed = push.some(Boolean);
    this.pushedSeconds = isPushed && isNear ? this.pushedSeconds + seconds : 0;
    /** @type {Vector} */
    let wanted = [0, 0, 0];
    this.pushDirections.forEach((direction, i) => {
      wanted = M.add(wanted, M.mul(direction, push[i] * this.pace));
    });
    this.velocity = M.mix(this.velocity, wanted, 1 - Math.exp(-seconds / EASE_SECONDS));
    if (M.length(this.velocity) < 1e-3 * this.pace) {
      this.velocity = [0, 0, 0];
      return;
    }
    this.flight = null;
    this.moveBy(M.mul(this.velocity, seconds));
  }

  /** Turns the camera upright, without changing its direction. */
  level() {
    this.wxyz = M.looking(this.forward, this.up);
  }

  /**
   * Moves the camera to a view without a flight. The focus is placed in front of the
   * camera, at the same distance as before.
   * @param {Pinhole} view
   */
  put(view) {
    const { distance } = this;
    this.wxyz = M.unit(view.wxyz);
    this.position = view.position;
    this.fov_y = view.fov_y;
    this.focus = M.add(this.position, M.mul(this.forward, distance));
    this.velocity = [0, 0, 0];
    this.flight = null;
  }

  /**
   * Starts a flight to a view.
   * @param {Pinhole} view
   * @param {Vector | null} focus The focus of the view; null for a point in front of
   *   it.
   */
  flyTo(view, focus) {
    const forward = M.rotate(view.wxyz, [0, 0, 1]);
    const ahead = M.add(view.position, M.mul(forward, this.distance));
    const from = { ...this.view(1), focus: this.focus };
    this.flight = { from, to: { ...view, focus: focus ?? ahead }, seconds: 0 };
  }

  /**
   * Starts a flight to a view of a point. The camera stays on the side of the point
   * where it is now.
   * @param {Vector} point
   * @param {number} distance
   */
  lookAt(point, distance) {
    const back = M.unit(M.sub(this.position, point));
    const position = M.add(point, M.mul(back, distance));
    const wxyz = M.looking(M.mul(back, -1), this.up);
    this.flyTo({ wxyz, position, fov_y: this.fov_y }, point);
  }

  /**
   * @param {number} seconds The time since the last call.
   */
  advance(seconds) {
    if (!this.flight) return;
    const { from, to } = this.flight;
    this.flight.seconds += seconds;
    const share = Math.min(this.flight.seconds / FLIGHT_SECONDS, 1);
    const t = share * share * (3 - 2 * share);
    this.wxyz = M.slerp(from.wxyz, to.wxyz, t);
    this.position = M.mix(from.position, to.position, t);
    this.focus = M.mix(from.focus, to.focus, t);
    this.fov_y = from.fov_y + t * (to.fov_y - from.fov_y);
    if (share === 1) {
      this.wxyz = M.unit(to.wxyz);
      this.position = to.position;
      this.fov_y = to.fov_y;
      this.focus = to.focus;
      this.flight = null;
    }
  }
}
