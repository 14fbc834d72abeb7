// The page of an exported scene: its controls, and how the camera moves.

import { AXES, Camera, isMode } from "./camera.js";
import * as M from "./math.js";
import { eyeOf } from "./placement.js";
import { isDrawable } from "./renderer.js";
import { open } from "./viewer.js";

/** @typedef {import("./scene_file.js").NamedCamera} NamedCamera */

const SCENE = "scene.json";
const NEAR_SHARE = 1e-4;
const WHEEL_RATE = 0.0012;
const MOST_WHEEL_PX = 300;
const MOST_STEP_SECONDS = 0.1;
const MOST_PIXEL_RATIO = 2;
/** Movements to the right, up and forward, by the code of the key. */
const PUSHES = new Map([
  ["KeyW", [0, 0, 1]],
  ["KeyS", [0, 0, -1]],
  ["KeyA", [-1, 0, 0]],
  ["KeyD", [1, 0, 0]],
  ["KeyE", [0, 1, 0]],
  ["KeyQ", [0, -1, 0]],
  ["ArrowUp", [0, 0, 1]],
  ["ArrowDown", [0, 0, -1]],
  ["ArrowLeft", [-1, 0, 0]],
  ["ArrowRight", [1, 0, 0]],
]);

const element = (/** @type {string} */ id) => document.getElementById(id);
const canvas = /** @type {HTMLCanvasElement} */ (element("canvas"));

/** @param {string} text A line of plain text; empty to hide it. */
function say(text) {
  element("notice").textContent = text;
}

/** @param {number} count */
function shortened(count) {
  if (count >= 1e6) return `${(count / 1e6).toFixed(1)} M`;
  return count >= 1e4 ? `${Math.round(count / 1e3)} k` : String(count);
}

/** @param {number} bytes */
function megabytes(bytes) {
  return `${(bytes / 2 ** 20).toFixed(1)} MiB`;
}

class Page {
  camera = new Camera();
  /** Codes of keys that are held. @type {Set<string>} */
  keys = new Set();
  /** Positions of pressed pointers, by their id. @type {Map<number, number[]>} */
  pointers = new Map();
  near = 0.01;
  isMoving = false;
  lastTime = 0;

  /** @param {import("./viewer.js").Viewer} viewer */
  constructor(viewer) {
    this.viewer = viewer;
    viewer.addEventListener("opened", () => this.begin());
    viewer.addEventListener("progress", () => this.showFigures());
    viewer.addEventListener("settled", () => this.showFigures());
    for (const type of ["notice", "failure"]) {
      viewer.addEventListener(type, (event) => say(/** @type {CustomEvent} */ (event).detail.text));
    }
  }

  begin() {
    const { viewer, camera } = this;
    const [x, y, z, radius] = viewer.ball;
    camera.radius = radius;
    camera.up = AXES[viewer.up ?? "-y"];
    this.near = NEAR_SHARE * radius;
    const away = M.unit(M.add(M.axisAcross(camera.up), M.mul(camera.up, 0.35)));
    camera.focus = [x, y, z];
    camera.position = M.add(camera.focus, M.mul(away, 1.6 * radius));
    camera.wxyz = M.looking(M.mul(away, -1), camera.up);
    this.fillPanel();
    this.listen();
    if (viewer.cameras.length > 0) this.lookThrough(viewer.cameras[0]);
    else this.redraw();
  }

  fillPanel() {
    const { viewer } = this;
    element("panel").hidden = false;
    element("views").hidden = viewer.cameras.length === 0;
    const view = /** @type {HTMLSelectElement} */ (element("view"));
    view.append(...viewer.cameras.map(({ name }) => new Option(name)));
    view.addEventListener("change", () => this.lookThrough(viewer.cameras[view.selectedIndex]));
    const mode = /** @type {HTMLSelectElement} */ (element("mode"));
    mode.addEventListener("change", () => {
      if (isMode(mode.value)) this.camera.mode = mode.value;
    });
    this.bindSlider("budget", (value) => shortened(Math.round(value)));
    this.bindSlider("tolerance", (value) => `${value.toPrecision(2)} px²`);
  }

  /**
   * Let a slider set a setting, on a logarithmic scale.
   *
   * @param {"budget" | "tolerance"} name
   * @param {(value: number) => string} text
   */
  bindSlider(name, text) {
    const slider = /** @type {HTMLInputElement} */ (element(name));
    slider.value = String(Math.log10(this.viewer.settings[name]));
    const show = () => {
      element(`${name}_text`).textContent = text(this.viewer.settings[name]);
    };
    slider.addEventListener("input", () => {
      this.viewer.set({ [name]: 10 ** Number(slider.value) });
      show();
    });
    show();
  }

  /** @param {NamedCamera} view */
  lookThrough({ viewmat, k, width, height, near }) {
    const rows = [0, 1, 2].map((row) => Array.from(viewmat).slice(4 * row, 4 * row + 3));
    const wxyz = M.unit(M.fromAxes(rows[0], rows[1], rows[2]));
    const position = eyeOf(viewmat);
    this.near = near;
    // put() moves the focus ahead of the camera, at this distance.
    this.camera.position = position;
    this.camera.focus = this.viewer.ball.slice(0, 3);
    // All of the view is visible in windows of any shape.
    const slopeX = (width / (2 * k[0])) * (canvas.clientHeight / canvas.clientWidth);
    const slope = Math.max(height / (2 * k[4]), slopeX);
    this.camera.put({ wxyz, position, fov_y: 2 * Math.atan(slope) });
    this.redraw();
  }

  listen() {
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    canvas.addEventListener("pointermove", (event) => this.movePointer(event));
    for (const type of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(type, (event) => {
        this.pointers.delete(/** @type {PointerEvent} */ (event).pointerId);
      });
    }
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    addEventListener("keydown", (event) => this.press(event));
    addEventListener("keyup", (event) => this.keys.delete(event.code));
    addEventListener("blur", () => this.keys.clear());
    new ResizeObserver(() => this.redraw()).observe(canvas);
  }

  /** @param {KeyboardEvent} event */
  press(event) {
    const isTyping = event.target instanceof HTMLInputElement;
    if (isTyping || event.ctrlKey || event.metaKey || !PUSHES.has(event.code)) return;
    event.preventDefault();
    this.keys.add(event.code);
    this.startMoving();
  }

  /** @param {PointerEvent} event */
  movePointer(event) {
    const before = this.pointers.get(event.pointerId);
    if (before === undefined) return;
    const place = [event.clientX, event.clientY];
    const [dx, dy] = M.sub(place, before);
    const other = [...this.pointers].find(([id]) => id !== event.pointerId)?.[1];
    if (other !== undefined) this.pinch(before, place, other);
    else if (event.shiftKey || event.buttons !== 1) this.pan(dx, dy);
    else this.turn(dx, dy);
    this.pointers.set(event.pointerId, place);
    this.redraw();
  }

  /**
   * @param {number} dx
   * @param {number} dy
   */
  turn(dx, dy) {
    const { camera } = this;
    const height = canvas.clientHeight;
    if (camera.mode === "orbit") camera.turn((-Math.PI * dx) / height, (-Math.PI * dy) / height);
    else camera.turn((camera.fov_y * dx) / height, (camera.fov_y * dy) / height);
  }

  /**
   * @param {number} dx
   * @param {number} dy
   */
  pan(dx, dy) {
    const { camera } = this;
    const size = 2 * Math.tan(camera.fov_y / 2) * camera.distance;
    const step = size / canvas.clientHeight;
    camera.shift(-dx * step, -dy * step, 0);
  }

  /**
   * Two fingers: spreading them moves the camera closer.
   *
   * @param {number[]} before
   * @param {number[]} place
   * @param {number[]} other
   */
  pinch(before, place, other) {
    const spread = (/** @type {number[]} */ at) => Math.max(M.length(M.sub(at, other)), 10);
    this.camera.approach(M.clamp(spread(before) / spread(place), 0.5, 2));
    const [dx, dy] = M.sub(place, before);
    this.pan(dx / 2, dy / 2);
  }

  /** @param {WheelEvent} event */
  wheel(event) {
    event.preventDefault();
    const px = M.clamp(event.deltaY, -MOST_WHEEL_PX, MOST_WHEEL_PX);
    if (this.camera.mode === "orbit") this.camera.approach(Math.exp(px * WHEEL_RATE));
    else this.camera.shift(0, 0, -px * 0.002 * this.camera.pace);
    this.redraw();
  }

  startMoving() {
    if (this.isMoving) return;
    this.isMoving = true;
    this.lastTime = performance.now();
    requestAnimationFrame((time) => this.step(time));
  }

  /** @param {number} time */
  step(time) {
    const seconds = Math.min((time - this.lastTime) / 1000, MOST_STEP_SECONDS);
    this.lastTime = time;
    let push = [0, 0, 0];
    for (const key of this.keys) push = M.add(push, PUSHES.get(key));
    this.camera.move(push, Math.max(seconds, 0));
    this.redraw();
    this.isMoving = this.keys.size > 0 || this.camera.velocity.some(Boolean);
    if (this.isMoving) requestAnimationFrame((next) => this.step(next));
  }

  /** Draw what the camera sees. */
  redraw() {
    let ratio = Math.min(devicePixelRatio, MOST_PIXEL_RATIO);
    while (!isDrawable(canvas.clientWidth * ratio, canvas.clientHeight * ratio)) ratio /= 2;
    const width = Math.max(1, Math.round(canvas.clientWidth * ratio));
    const height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    const { camera } = this;
    const rows = [camera.right, camera.down, camera.forward];
    const viewmat = rows.flatMap((row) => row.concat(-M.dot(row, camera.position)));
    const focal = height / (2 * Math.tan(camera.fov_y / 2));
    this.viewer.setCamera({
      viewmat: [...viewmat, 0, 0, 0, 1],
      k: [focal, 0, width / 2, 0, focal, height / 2, 0, 0, 1],
      near: this.near,
      width,
      height,
    });
  }

  showFigures() {
    const { viewer } = this;
    const state = viewer.isSettled ? "" : ", loading";
    const parts = [
      `${shortened(viewer.numGaussians)} gaussians${state}`,
      `${megabytes(viewer.receivedBytes)} received`,
      `${megabytes(viewer.memoryBytes)} of graphics memory`,
    ];
    element("figures").textContent = parts.join(" · ");
  }
}

/** Return the settings in the page's address; what is no positive number is ignored. */
function settingsOfAddress() {
  const query = new URLSearchParams(location.search);
  const names = ["budget", "tolerance"].filter((name) => Number(query.get(name)) > 0);
  return Object.fromEntries(names.map((name) => [name, Number(query.get(name))]));
}

try {
  const viewer = await open(canvas, SCENE, settingsOfAddress());
  window.viewer = viewer;
  window.page = new Page(viewer);
} catch (error) {
  say(error.message);
}
