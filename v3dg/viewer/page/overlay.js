// Draws over the picture: frusta, the selected instance, the box of a crop, and the
// axes.

import { Compass } from "./compass.js";
import { Crop } from "./crop.js";
import { element } from "./elements.js";
import { Frusta } from "./frusta.js";
import { Handles } from "./handles.js";
import { Projection } from "./projection.js";

/** @typedef {import("./app.js").App} App */

/** Minimum width of a window that shows the axes. */
const LEAST_WIDTH_OF_COMPASS_PX = 700;

export class Overlay {
  canvas = /** @type {HTMLCanvasElement} */ (element("overlay"));
  context = this.canvas.getContext("2d");

  /** @param {App} app */
  constructor(app) {
    this.app = app;
    this.projection = new Projection(app.camera, this.context);
    this.frusta = new Frusta(app, this.projection);
    this.handles = new Handles(app, this.projection);
    this.crop = new Crop(app, this.projection);
    this.compass = new Compass(app.camera);
  }

  /**
   * Adapts the canvas to the window.
   *
   * @param {number} width The width in px of the web page.
   * @param {number} height The height in px of the web page.
   */
  resize(width, height) {
    const ratio = window.devicePixelRatio || 1;
    this.canvas.width = Math.round(width * ratio);
    this.canvas.height = Math.round(height * ratio);
    this.context.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.compass.resize(ratio);
    this.projection.width = width;
    this.projection.height = height;
  }

  draw() {
    const { app, context, projection } = this;
    if (projection.width > LEAST_WIDTH_OF_COMPASS_PX) this.compass.draw();
    const { frozen } = app.look.settings;
    const hasObject = app.instances.selected || this.crop.isOn;
    const isEmpty = !frozen && !app.fileCameras.showsFrusta && !hasObject;
    // If nothing is drawn, the layer is made transparent, because blending it takes
    // long without a GPU.
    this.canvas.style.opacity = isEmpty ? "0" : "1";
    if (isEmpty) return;
    context.clearRect(0, 0, projection.width, projection.height);
    // Browsers may not show a frame that was only cleared, so fill it with an invisible
    // colour.
    context.fillStyle = "#00000003";
    context.fillRect(0, 0, 1, 1);
    if (frozen) this.frusta.drawFrozen(frozen);
    if (app.fileCameras.showsFrusta) this.frusta.draw();
    if (app.instances.selected) this.handles.draw();
    if (this.crop.isOn) this.crop.draw();
  }
}
