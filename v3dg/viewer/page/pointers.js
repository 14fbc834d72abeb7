// Mouse and touch. A drag turns the camera or moves an instance, a click picks, and the
// wheel changes the distance.

import * as M from "./math.js";

/** @typedef {import("./app.js").App} App */
/** @typedef {import("./page.js").Place} Place */
/** @typedef {{ x: number, y: number, time: number, hasMoved: boolean, button: number }} Press */

/** A press counts as a click if it moves less and takes less time than this. */
const CLICK_PX = 5;
const CLICK_MS = 500;
/**
 * A click counts as a double click if it is this close to the last click, in px and in
 * time.
 */
const DOUBLE_CLICK_PX = 12;
const DOUBLE_CLICK_MS = 400;
/** Largest distance between a press and a handle, px. */
const SLACK_OF_TOUCH = 24;
const SLACK_OF_MOUSE = 11;
/** Number of px per line, for wheels that scroll by lines. */
const LINE_PX = 33;
const MOST_WHEEL_PX = 300;

export class Pointers {
  /**
   * Positions of the mouse while a button is pressed, or of fingers, by the pointer's
   * id.
   *
   * @type {Map<number, Place>}
   */
  places = new Map();
  /**
   * The first press of the current pointers; null before any press.
   *
   * @type {Press}
   */
  start = null;
  /**
   * The last click; null before the first one.
   *
   * @type {{ x: number, y: number, time: number }}
   */
  lastClick = null;

  /** @param {App} app */
  constructor(app) {
    this.app = app;
    this.surface = app.overlay.canvas;
    const { surface } = this;
    surface.addEventListener("pointerdown", (event) => this.press(event));
    surface.addEventListener("pointermove", (event) => this.move(event));
    for (const kind of /** @type {const} */ (["pointerup", "pointercancel"])) {
      surface.addEventListener(kind, (event) => this.release(event));
    }
    surface.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    surface.addEventListener("contextmenu", (event) => event.preventDefault());
  }

  /**
   * Returns the position of a pointer in the picture.
   *
   * @param {PointerEvent} event
   * @returns {Place}
   */
  placeOf(event) {
    const box = this.surface.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  /**
   * Handles a button that is pressed, or a finger that touches.
   *
   * @param {PointerEvent} event
   */
  press(event) {
    const { crop, instances, overlay } = this.app;
    const { button, pointerId, pointerType } = event;
    this.surface.focus({ preventScroll: true });
    this.surface.setPointerCapture(pointerId);
    const [x, y] = this.placeOf(event);
    this.places.set(pointerId, [x, y]);
    instances.grip = null;
    crop.grip = null;
    if (this.places.size > 1) {
      this.start.hasMoved = true; // a press with two fingers cannot be a click
      return;
    }
    this.start = { x, y, time: performance.now(), hasMoved: false, button };
    const slack = pointerType === "touch" ? SLACK_OF_TOUCH : SLACK_OF_MOUSE;
    if (button !== 0 || crop.gripAt(x, y, slack)) return;
    instances.grip = overlay.handles.gripAt(x, y, slack);
  }

  /**
   * Handles a pointer that moves.
   *
   * @param {PointerEvent} event
   */
  move(event) {
    const { app } = this;
    const [x, y] = this.placeOf(event);
    const before = this.places.get(event.pointerId);
    if (!before) {
      app.fileCameras.hover(app.overlay.frusta.cameraAt(x, y));
      return;
    }
    if (Math.hypot(x - this.start.x, y - this.start.y) > CLICK_PX) this.start.hasMoved = true;
    if (this.places.size === 2) this.pinch(event.pointerId, before, [x, y]);
    else if (app.crop.grip) app.crop.drag(x, y);
    else if (app.instances.grip) app.instances.setPose(app.overlay.handles.drag(x, y));
    else if (this.start.hasMoved) this.drag(x - before[0], y - before[1], event.shiftKey);
    else return; // the press may still become a click
    this.places.set(event.pointerId, [x, y]);
    app.redraw();
  }

  /**
   * Handles two fingers. Moving them moves the camera sideways, and spreading them
   * moves it closer.
   *
   * @param {number} pointerId The id of the finger that moves.
   * @param {Place} before
   * @param {Place} now
   */
  pinch(pointerId, before, now) {
    const [, other] = [...this.places].find(([id]) => id !== pointerId);
    const spread = (/** @type {Place} */ place) => Math.max(M.length(M.sub(place, other)), 10);
    this.app.camera.approach(M.clamp(spread(before) / spread(now), 0.5, 2));
    const [dx, dy] = M.sub(now, before);
    this.pan(dx / 2, dy / 2);
  }

  /**
   * Handles a drag.
   *
   * @param {number} dx
   * @param {number} dy
   * @param {boolean} hasShift Whether Shift is held, so that the camera moves sideways.
   */
  drag(dx, dy, hasShift) {
    const { camera } = this.app;
    const height = this.surface.clientHeight;
    if (this.start.button !== 0 || hasShift) {
      this.pan(dx, dy);
    } else if (camera.mode === "orbit") {
      camera.turn((-Math.PI * dx) / height, (-Math.PI * dy) / height);
    } else {
      camera.turn((camera.fov_y * dx) / height, (camera.fov_y * dy) / height);
    }
  }

  /**
   * Moves the camera sideways, such that the focus follows the pointer.
   *
   * @param {number} dx
   * @param {number} dy
   */
  pan(dx, dy) {
    const { camera } = this.app;
    const distance = Math.max(camera.distance, 0.05 * camera.radius);
    const height = 2 * Math.tan(camera.fov_y / 2) * distance;
    const step = height / this.surface.clientHeight;
    camera.shift(-dx * step, -dy * step, 0);
  }

  /**
   * Handles a button that is released, or a finger that is lifted.
   *
   * @param {PointerEvent} event
   */
  release(event) {
    if (!this.places.delete(event.pointerId)) return;
    if (this.app.crop.grip) {
      this.app.crop.letGo();
      return;
    }
    if (this.app.instances.grip) {
      this.app.instances.letGo();
      return;
    }
    const { time, hasMoved, button } = this.start;
    const isShort = performance.now() - time < CLICK_MS;
    if (event.type === "pointerup" && !hasMoved && button === 0 && isShort) {
      this.click(...this.placeOf(event));
    }
  }

  /**
   * Handles a click at a position in the picture.
   *
   * @param {number} x
   * @param {number} y
   */
  click(x, y) {
    const { app, lastClick } = this;
    const time = performance.now();
    const isSoon = lastClick !== null && time - lastClick.time < DOUBLE_CLICK_MS;
    const isDouble = isSoon && Math.hypot(x - lastClick.x, y - lastClick.y) < DOUBLE_CLICK_PX;
    this.lastClick = { x, y, time };
    const { clientWidth, clientHeight } = this.surface;
    const camera = app.overlay.frusta.cameraAt(x, y);
    if (camera >= 0) app.fileCameras.lookThrough(camera);
    else if (isDouble) app.instances.pickAndFly(x / clientWidth, y / clientHeight);
    else app.instances.pick(x / clientWidth, y / clientHeight);
  }

  /**
   * Handles the wheel of the mouse.
   *
   * @param {WheelEvent} event
   */
  wheel(event) {
    event.preventDefault();
    const { camera } = this.app;
    const isInLines = event.deltaMode === WheelEvent.DOM_DELTA_LINE;
    const px = event.deltaY * (isInLines ? LINE_PX : 1);
    const bounded = M.clamp(px, -MOST_WHEEL_PX, MOST_WHEEL_PX);
    if (camera.mode === "orbit") camera.approach(Math.exp(bounded * 0.0012));
    else camera.shift(0, 0, -bounded * 0.002 * camera.pace);
    this.app.redraw();
  }
}
