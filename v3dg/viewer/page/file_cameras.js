// The cameras of the file. Their frusta can be clicked, and their photographs are shown
// over the picture.

import * as M from "./math.js";
import { element } from "./elements.js";

/** @typedef {import("./app.js").App} App */
/** @typedef {import("./protocol.js").FileCamera} FileCamera */
/** @typedef {import("./protocol.js").View} View */

export class FileCameras {
  photograph = /** @type {HTMLImageElement} */ (element("photograph"));
  /** @type {FileCamera[]} */
  list = [];
  showsFrusta = false;
  /** Depth of a frustum, in radii of the scene. */
  frustumSize = 0.05;
  /** Opacity of photographs. */
  opacity = 0.5;
  /** Index of the camera whose frustum is under the pointer, or -1. */
  hovered = -1;
  /**
   * The view of the photograph that is shown; null if there is none.
   *
   * @type {View}
   */
  photographView = null;

  /** @param {App} app */
  constructor(app) {
    this.app = app;
  }

  /**
   * Sets the cameras of a scene.
   *
   * @param {FileCamera[]} cameras
   */
  begin(cameras) {
    this.list = cameras;
    this.showsFrusta = this.hasPhotographs;
  }

  /** Removes the cameras when another scene is opened. */
  reset() {
    this.list = [];
  }

  get hasPhotographs() {
    return this.list.some((camera) => camera.photograph);
  }

  /**
   * Shows or hides the frusta.
   *
   * @param {boolean} isShown
   */
  showFrusta(isShown) {
    this.showsFrusta = isShown;
    this.app.sync();
  }

  /**
   * Sets the depth of frusta, in radii of the scene.
   *
   * @param {number} size
   */
  setFrustumSize(size) {
    this.frustumSize = size;
    this.app.sync();
  }

  /**
   * Sets the opacity of photographs.
   *
   * @param {number} opacity
   */
  setOpacity(opacity) {
    this.opacity = opacity;
    this.app.sync();
  }

  /**
   * Highlights the frustum of a camera.
   *
   * @param {number} index The index of the camera, or -1.
   */
  hover(index) {
    if (index === this.hovered) return;
    this.hovered = index;
    this.app.overlay.canvas.title = this.list[index]?.name ?? "";
    this.app.redraw();
  }

  /**
   * Returns the index of the camera with a name, or -1.
   *
   * @param {string} name
   */
  indexOf(name) {
    return this.list.findIndex((camera) => camera.name === name);
  }

  /**
   * Flies to a camera, such that its whole picture fits into the window, and shows its
   * photograph.
   *
   * @param {number} index
   */
  lookThrough(index) {
    const { app } = this;
    const { view, photograph } = this.list[index];
    const { aspect } = app.look;
    const tangent = Math.tan(view.fov_y / 2) * Math.max(1, view.aspect / aspect);
    const fitted = { ...view, fov_y: 2 * Math.atan(tangent), aspect };
    const forward = M.rotate(view.wxyz, [0, 0, 1]);
    const ahead = M.dot(M.sub(app.scene.center, view.position), forward);
    const distance = Math.max(ahead, 0.05 * app.scene.radius);
    app.camera.flyTo(fitted, M.add(view.position, M.mul(forward, distance)));
    this.photographView = null;
    if (photograph) {
      this.fitPhotograph(view, tangent);
      this.photograph.src = `photograph/${index}`;
      this.photographView = fitted;
    }
    app.redraw();
  }

  /**
   * Positions the photograph in the window.
   *
   * @param {View} view The view of the photograph's camera.
   * @param {number} tangent The tangent of half the window's vertical field of view.
   */
  fitPhotograph(view, tangent) {
    const { clientWidth, clientHeight } = this.app.look.stage;
    const height = (clientHeight * Math.tan(view.fov_y / 2)) / tangent;
    const width = height * view.aspect;
    const { style } = this.photograph;
    style.left = `${(clientWidth - width) / 2}px`;
    style.top = `${(clientHeight - height) / 2}px`;
    style.width = `${width}px`;
    style.height = `${height}px`;
  }

  /** Shows the photograph while the camera is at its view, and otherwise hides it. */
  placePhotograph() {
    const isThere = this.photographView !== null && this.app.camera.isAt(this.photographView);
    this.photograph.hidden = !isThere || this.opacity === 0;
    this.photograph.style.opacity = String(this.opacity);
  }
}
