// Where the page looks from, and how that moves. Lengths are in the scene's units.

import * as M from "./math.js";

export const AXES = {
  x: [1, 0, 0], y: [0, 1, 0], z: [0, 0, 1], "-x": [-1, 0, 0], "-y": [0, -1, 0], "-z": [0, 0, -1],
};
const SECONDS_OF_A_FLIGHT = 0.6;
const STEEPEST = 0.998; // sine of the angle to the horizon

export class Camera {
  constructor() {
    this.position = [0, -3, 1];
    this.wxyz = M.looking([0, 3, -1], [0, 0, 1]);
    this.fov_y = Math.PI / 4;
    this.focus = [0, 0, 0]; // which orbits go around
    this.up = [0, 0, 1];
    this.mode = "orbit";
    this.speed = 1; // of the slider
    this.radius = 1; // of the scene
    this.ahead = null; // distance to what is in the middle of the picture
    this.velocity = [0, 0, 0];
    this.held = 0; // seconds for which one has pushed against what is near
    this.flight = null;
  }

  get right() { return M.rotate(this.wxyz, [1, 0, 0]); }
  get down() { return M.rotate(this.wxyz, [0, 1, 0]); }
  get forward() { return M.rotate(this.wxyz, [0, 0, 1]); }
  get distance() { return Math.max(M.length(M.sub(this.focus, this.position)), 1e-4 * this.radius); }

  // Units a second at the slider's 1: the scene's size tells how quick, what is near how careful.
  get pace() {
    const near = this.ahead ?? this.radius;
    return this.speed * M.clamp(0.6 * near, this.least, 0.6 * this.radius);
  }

  // However near things are: careful at first, but who goes on pushing comes through.
  get least() {
    return 0.02 * this.radius * M.clamp(2 ** (2 * (this.held - 0.5)), 1, 10);
  }

  view(aspect) {
    return { wxyz: this.wxyz, position: this.position, fov_y: this.fov_y, aspect };
  }

  // Turn about the upright axis and about the horizon, in radians; around the focus where one orbits.
  turn(yaw, pitch) {
    this.flight = null;
    const pivot = this.mode === "orbit" ? this.focus : this.position;
    const turned = (q) => {
      this.wxyz = M.unit(M.product(q, this.wxyz));
      this.position = M.add(pivot, M.rotate(q, M.sub(this.position, pivot)));
    };
    turned(M.about(this.up, yaw));
    const before = M.dot(this.forward, this.up);
    const after = M.dot(M.rotate(M.about(this.right, pitch), this.forward), this.up);
    if (Math.abs(after) < STEEPEST || Math.abs(after) < Math.abs(before)) turned(M.about(this.right, pitch));
    if (this.mode !== "orbit") this.carryFocus();
  }

  // The focus stays in front, as far as it was.
  carryFocus() {
    this.focus = M.add(this.position, M.mul(this.forward, this.distance));
  }

  // Move by steps to the right, down and forward.
  shift(right, down, forward) {
    this.flight = null;
    const step = M.add(M.add(M.mul(this.right, right), M.mul(this.down, down)), M.mul(this.forward, forward));
    this.position = M.add(this.position, step);
    this.focus = M.add(this.focus, step);
  }

  // Go nearer to the focus by a factor; past it, the focus goes ahead.
  approach(factor) {
    this.flight = null;
    const least = 0.02 * this.radius;
    const away = M.sub(this.position, this.focus);
    if (factor < 1 && this.distance * factor < least) this.shift(0, 0, this.distance * (1 - factor));
    else this.position = M.add(this.focus, M.mul(away, factor));
  }

  // Move for so many seconds; `push` is right, up and forward, each -1 to 1.
  move(push, seconds) {
    const ways = this.mode === "walk"
      ? [this.right, this.up, M.unit(M.cross(this.up, this.right))]
      : [this.right, this.mode === "fly" ? M.mul(this.down, -1) : this.up, this.forward];
    const isNear = push.some(Boolean) && 0.6 * (this.ahead ?? this.radius) < 0.05 * this.radius;
    this.held = isNear ? this.held + seconds : 0;
    const wanted = push.reduce((sum, part, i) => M.add(sum, M.mul(ways[i], part * this.pace)), [0, 0, 0]);
    this.velocity = M.mix(this.velocity, wanted, 1 - Math.exp(-seconds / 0.07));
    if (M.length(this.velocity) < 1e-3 * this.pace) {
      this.velocity = [0, 0, 0];
      return;
    }
    this.flight = null;
    const step = M.mul(this.velocity, seconds);
    this.position = M.add(this.position, step);
    this.focus = M.add(this.focus, step);
  }

  // Stand upright again, looking where one looks.
  level() {
    this.wxyz = M.looking(this.forward, this.up);
  }

  put(view) {
    const distance = this.distance;
    [this.wxyz, this.position, this.fov_y] = [M.unit(view.wxyz), view.position, view.fov_y];
    this.focus = M.add(this.position, M.mul(this.forward, distance));
    this.velocity = [0, 0, 0];
    this.flight = null;
  }

  // Fly to a view, to turn about a point, or about what is ahead of it.
  flyTo(view, focus) {
    const forward = M.rotate(view.wxyz, [0, 0, 1]);
    const from = { wxyz: this.wxyz, position: this.position, fov_y: this.fov_y, focus: this.focus };
    const to = { ...view, focus: focus ?? M.add(view.position, M.mul(forward, this.distance)) };
    this.flight = { from, to, seconds: 0 };
  }

  // Look at a point from so far, from the side that one is on.
  lookAt(point, distance) {
    const from = M.unit(M.sub(this.position, point));
    const position = M.add(point, M.mul(from, distance));
    this.flyTo({ wxyz: M.looking(M.mul(from, -1), this.up), position, fov_y: this.fov_y }, point);
  }

  // Go on with a flight.
  advance(seconds) {
    if (!this.flight) return;
    const { from, to } = this.flight;
    this.flight.seconds += seconds;
    const share = Math.min(this.flight.seconds / SECONDS_OF_A_FLIGHT, 1);
    const t = share * share * (3 - 2 * share);
    this.wxyz = M.slerp(from.wxyz, to.wxyz, t);
    this.position = M.mix(from.position, to.position, t);
    this.focus = M.mix(from.focus, to.focus, t);
    this.fov_y = from.fov_y + t * (to.fov_y - from.fov_y);
    if (share === 1) {
      [this.wxyz, this.position, this.fov_y, this.focus] = [M.unit(to.wxyz), to.position, to.fov_y, to.focus];
      this.flight = null;
    }
  }
}
