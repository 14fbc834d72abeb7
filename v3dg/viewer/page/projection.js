// Projects points of the world into the picture, and draws lines between them.

import * as M from "./math.js";

/** @typedef {import("./camera.js").Camera} Camera */
/** @typedef {import("./page.js").Place} Place */
/** @typedef {import("./page.js").Vector} Vector */
/** @typedef {[Vector, Vector]} Line */

/** Points and lines closer to the camera than this are not drawn; in radii of the scene. */
const NEAREST_POINT = 1e-6;
const NEAREST_OF_LINE = 1e-4;

export class Projection {
  /** Size of the picture, px. */
  width = 0;
  height = 0;

  /**
   * @param {Camera} camera
   * @param {CanvasRenderingContext2D} context The context for drawing lines.
   */
  constructor(camera, context) {
    this.camera = camera;
    this.context = context;
  }

  /** Focal length, px. */
  get focal() {
    return this.height / 2 / Math.tan(this.camera.fov_y / 2);
  }

  /**
   * Returns a point in the camera's coordinates: right, down and forward.
   *
   * @param {Vector} point
   */
  inCamera(point) {
    return M.rotate(M.inverse(this.camera.wxyz), M.sub(point, this.camera.position));
  }

  /**
   * @param {Vector} point A point in the camera's coordinates, in front of it.
   * @returns {Place}
   */
  project([x, y, z]) {
    return [this.width / 2 + (this.focal * x) / z, this.height / 2 + (this.focal * y) / z];
  }

  /**
   * Returns the place of a point in the picture; null if it is behind the camera.
   *
   * @param {Vector} point
   */
  place(point) {
    const seen = this.inCamera(point);
    if (seen[2] < NEAREST_POINT * this.camera.radius) return null;
    return this.project(seen);
  }

  /**
   * Returns the direction of the ray through a place in the picture, in the world; its length is
   * arbitrary.
   *
   * @param {Place} place
   */
  ray([x, y]) {
    /** @type {Vector} */
    const ahead = [(x - this.width / 2) / this.focal, (y - this.height / 2) / this.focal, 1];
    return M.rotate(this.camera.wxyz, ahead);
  }

  /**
   * @param {string} color
   * @param {number} width Px.
   * @param {Line[]} lines
   */
  stroke(color, width, lines) {
    const { context } = this;
    context.strokeStyle = color;
    context.lineWidth = width;
    context.beginPath();
    for (const line of lines) this.addLine(line);
    context.stroke();
  }

  /** @param {Line} line A line, of which only the part in front of the camera is drawn. */
  addLine([start, end]) {
    const near = NEAREST_OF_LINE * this.camera.radius;
    let p = this.inCamera(start);
    let q = this.inCamera(end);
    if (p[2] < near && q[2] < near) return;
    if (p[2] < near) p = M.mix(q, p, (q[2] - near) / (q[2] - p[2]));
    if (q[2] < near) q = M.mix(p, q, (p[2] - near) / (p[2] - q[2]));
    this.context.moveTo(...this.project(p));
    this.context.lineTo(...this.project(q));
  }
}
