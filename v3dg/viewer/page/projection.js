// Projects points of the world to the picture, and draws lines between them.

import * as M from "./math.js";

/** @typedef {import("./camera.js").Camera} Camera */
/** @typedef {import("./page.js").Place} Place */
/** @typedef {import("./page.js").Vector} Vector */
/** @typedef {[Vector, Vector]} Line */

/**
 * Points and lines closer to the camera than this, in radii of the scene, are not
 * drawn.
 */
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
   * Returns a point in the camera's coordinates (right, down and forward).
   *
   * @param {Vector} point
   */
  inCamera(point) {
    return M.rotate(M.inverse(this.camera.wxyz), M.sub(point, this.camera.position));
  }

  /**
   * Returns the position of a point in the picture.
   *
   * @param {Vector} point A point in the camera's coordinates, in front of the camera.
   * @returns {Place}
   */
  project([x, y, z]) {
    return [this.width / 2 + (this.focal * x) / z, this.height / 2 + (this.focal * y) / z];
  }

  /**
   * Returns the position of a point in the picture, or null if the point is behind the
   * camera.
   *
   * @param {Vector} point
   */
  place(point) {
    const seen = this.inCamera(point);
    if (seen[2] < NEAREST_POINT * this.camera.radius) return null;
    return this.project(seen);
  }

  /**
   * Returns the direction of the ray through a position in the picture, in the world.
   * It may have any length.
   *
   * @param {Place} place
   */
  ray([x, y]) {
    /** @type {Vector} */
    const ahead = [(x - this.width / 2) / this.focal, (y - this.height / 2) / this.focal, 1];
    return M.rotate(this.camera.wxyz, ahead);
  }

  /**
   * Draws lines.
   *
   * @param {string} color
   * @param {number} width The width of the lines, px.
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

  /**
   * Adds a line to the current path.
   *
   * @param {Line} line A line, which is clipped to the part in front of the camera.
   */
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
