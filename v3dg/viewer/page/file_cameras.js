// The cameras of the file: frusta to click, and photographs that are shown over the picture.

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
  /** Index of the camera whose frustum is under the pointer; -1 if there is none. */
  hovered = -1;
  /**
   * The view of the photograph that is shown; null if none is shown.
   *
   * @type {View}
   */
  photographView = null;

  /** @param {App} app */
  constructor(app) {
    this.app = app;
  }

  /** @param {FileCamera[]} cameras */
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

  /** @param {boolean} isShown */
  showFrusta(isShown) {
    this.showsFrusta = isShown;
    this.app.sync();
  }

  /** @param {number} size */
  setFrustumSize(size) {
    this.frustumSize = size;
    this.app.sync();
  }

  /** @param {number} opacity */
  setOpacity(opacity) {
    this.opacity = opacity;
    this.app.sync();
  }

  /** @param {number} index */
  hover(index) {
    if (index === this.hovered) return;
    this.hovered = index;
    this.app.overlay.canvas.title = this.list[index]?.name ?? "";
    this.app.redraw();
  }

  /** @param {string} name */
  indexOf(name) {
    return this.list.findIndex((camera) => camera.name === name);
  }

  /**
   * Flies to a camera, so that its whole picture fits into the window, and shows its photograph.
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
   * @param {number} tangent Tangent of half the window's vertical field of view.
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

  /** Shows the photograph if the camera is at its view, and hides it otherwise. */
  placePhotograph() {
    const isThere = this.photographView !== null && this.app.camera.isAt(this.photographView);
    this.photograph.hidden = !isThere || this.opacity === 0;
    this.photograph.style.opacity = String(this.opacity);
  }
}
