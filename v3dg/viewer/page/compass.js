// Draws the axes of the world in a corner of the picture.

import * as M from "./math.js";
import { AXES } from "./camera.js";
import { element } from "./elements.js";

/** @typedef {import("./camera.js").Camera} Camera */

/** Colours of the x, y and z axes. */
export const AXIS_COLORS = ["#ff6b5e", "#7ad97a", "#5aa9ff"];
/** A dark outline makes the axes visible on bright pictures. */
const EDGE_COLOR = "#000c";
/**
 * Lengths in px of the page: the side of the canvas, the length of an axis, and the
 * distance of an axis's name.
 */
const SIDE = 80;
const MIDDLE = SIDE / 2;
const ARM = 20;
const NAME = 28;

export class Compass {
  canvas = /** @type {HTMLCanvasElement} */ (element("compass"));
  context = this.canvas.getContext("2d");

  /** @param {Camera} camera */
  constructor(camera) {
    this.camera = camera;
  }

  /**
   * Adapts the canvas to the screen.
   *
   * @param {number} ratio Number of screen px for each px of the page.
   */
  resize(ratio) {
    this.canvas.width = Math.round(SIDE * ratio);
    this.canvas.height = Math.round(SIDE * ratio);
    this.context.setTransform(ratio, 0, 0, ratio, 0, 0);
  }

  draw() {
    const { context } = this;
    context.clearRect(0, 0, SIDE, SIDE);
    context.font = "bold 12px system-ui";
    context.lineJoin = "round";
    context.textAlign = "center";
    context.textBaseline = "middle";
    const toCamera = M.inverse(this.camera.wxyz);
    const names = /** @type {const} */ (["x", "y", "z"]);
    const axes = names.map((name, i) => ({
      name,
      direction: M.rotate(toCamera, AXES[name]),
      color: AXIS_COLORS[i],
    }));
    // draw the farthest axis first
    axes.sort((a, b) => b.direction[2] - a.direction[2]);
    for (const { name, direction, color } of axes) this.drawAxis(name, direction, color);
  }

  /**
   * Draws an axis and its name.
   *
   * @param {string} name
   * @param {import("./page.js").Vector} direction The end of the axis in the camera's
   *   coordinates.
   * @param {string} color
   */
  drawAxis(name, [x, y], color) {
    const { context } = this;
    context.beginPath();
    context.moveTo(MIDDLE, MIDDLE);
    context.lineTo(MIDDLE + ARM * x, MIDDLE + ARM * y);
    context.strokeStyle = EDGE_COLOR;
    context.lineWidth = 5;
    context.stroke();
    context.strokeText(name, MIDDLE + NAME * x, MIDDLE + NAME * y);
    context.strokeStyle = color;
    context.lineWidth = 2;
    context.stroke();
    context.fillStyle = color;
    context.fillText(name, MIDDLE + NAME * x, MIDDLE + NAME * y);
  }
}
