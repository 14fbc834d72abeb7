// The interface of the viewer: `await open(canvas, url)` shows a scene file or a bundle.
//
// A worker selects cuts and reads pages (worker.js); this thread draws (renderer.js).
// The worker sends a page before the first cut that has it, and sends another page to
// the same place only after a cut without it. So a cut always finds its pages.
//
// To the worker: open (url, poolBytes), look (request), reset. From the worker: opened
// (instances, cameras, up, balls), page (place, bytes), cut (cut, tolerance, isSettled,
// missing, receivedBytes), notice (text), failure (text).

import { rotationOf } from "./placement.js";
import { NoDevice, Renderer } from "./renderer.js";

/** @typedef {import("./placement.js").Instances} Instances */
/** @typedef {import("./placement.js").Pinhole} Pinhole */

const DEFAULTS = {
  budget: 1_000_000,
  tolerance: 3,
  fade: 1.02,
  poolBytes: 2 ** 27,
  background: [0, 0, 0],
};

/** A scene on a canvas. Events: firstpicture, settled, progress, notice, opened, failure. */
export class Viewer extends EventTarget {
  /** Cameras of the scene file. @type {import("./scene_file.js").NamedCamera[]} */
  cameras = [];
  /** The axis that points up in the scene; null if unknown. */
  up = null;
  /** Centre and radius of the scene; null until it is open. @type {number[]} */
  ball = null;
  /** Gaussians of the cut that is drawn. */
  numGaussians = 0;
  /** Tolerance of that cut, which a budget raises, px² a gaussian. */
  tolerance = 0;
  /** Bytes that were received. */
  receivedBytes = 0;
  /** Whether nothing changes while the camera is still. */
  isSettled = false;
  /** @type {Renderer} */
  renderer = null;
  /** @type {Instances} */
  instances = null;
  /** @type {Pinhole} */
  camera = null;
  isClosed = false;
  /** The request for a frame; 0 if there is none. */
  request = 0;
  hasPicture = false;
  /** Frames that were drawn. */
  numFrames = 0;

  /**
   * @param {HTMLCanvasElement} canvas
   * @param {string} url
   * @param {Partial<typeof DEFAULTS>} options
   */
  constructor(canvas, url, options) {
    super();
    this.canvas = canvas;
    this.url = new URL(url, location.href).href;
    this.settings = { ...DEFAULTS, ...options };
  }

  /** Bytes of graphics memory. */
  get memoryBytes() {
    return this.renderer.memoryBytes;
  }

  async start() {
    await this.startRenderer();
    this.worker = new Worker(new URL("worker.js", import.meta.url), { type: "module" });
    this.worker.addEventListener("message", ({ data }) => this.receive(data));
    this.worker.addEventListener("error", () => {
      this.emit("failure", { text: "v3dg: the worker cannot be loaded; reload the page" });
    });
    const { poolBytes } = this.renderer;
    this.send({ type: "open", url: this.url, poolBytes });
    this.look();
  }

  async startRenderer() {
    this.renderer = await Renderer.create(this.canvas, this.settings.poolBytes);
    this.renderer.onGrown = () => this.invalidate();
    this.renderer.onLimit = (numPairs) => {
      const problem = `the picture needs ${numPairs} pairs of gaussians and tiles`;
      this.emit("notice", { text: `scene: ${problem}; lower the budget or the picture's size` });
    };
    this.renderer.device.lost.then(() => this.recover());
  }

  /** Draw with a new device when the browser has lost the device. */
  async recover() {
    if (this.isClosed) return;
    this.emit("notice", { text: "WebGPU: the device was lost; starting it again" });
    this.hasPicture = false;
    this.isSettled = false;
    try {
      await this.startRenderer();
    } catch (error) {
      this.emit("failure", { text: error.message });
      return;
    }
    this.send({ type: "reset" });
    this.emit("notice", { text: "" });
  }

  /**
   * @param {string} type
   * @param {object} detail
   */
  emit(type, detail = {}) {
    this.dispatchEvent(new CustomEvent(type, { detail }));
  }

  /** @param {object} message */
  send(message) {
    this.worker.postMessage(message, []);
  }

  /** @param {any} message */
  receive(message) {
    if (message.type === "page") this.renderer.writePage(message.place, message.bytes);
    else if (message.type === "cut") this.receiveCut(message);
    else if (message.type === "opened") this.receiveScene(message);
    else this.emit(message.type, { text: message.text });
  }

  /** @param {any} message */
  receiveScene({ instances, cameras, up, balls }) {
    this.instances = instances;
    this.cameras = cameras;
    this.up = up;
    this.ball = ballAround(instances, balls);
    this.emit("opened");
  }

  /** @param {any} message */
  receiveCut({ cut, isSettled, missing, receivedBytes, tolerance }) {
    const most = this.renderer.mostGaussians;
    if (cut.count > most) {
      const problem = `the coarsest picture has ${cut.count} gaussians`;
      this.emit("notice", { text: `scene: ${problem}, and this device can draw ${most}` });
      return;
    }
    this.renderer.setCut(cut);
    this.numGaussians = cut.count;
    this.tolerance = tolerance;
    this.receivedBytes = receivedBytes;
    this.emit("progress", { missing });
    this.invalidate();
    const hasSettled = isSettled && !this.isSettled;
    this.isSettled = isSettled;
    if (hasSettled) this.emit("settled");
  }

  /**
   * Set the camera. Its size is that of the picture in px.
   *
   * @param {Pinhole} camera
   */
  setCamera(camera) {
    this.camera = camera;
    this.look();
    this.invalidate();
  }

  /**
   * Change `budget`, `tolerance`, `fade` or `background`.
   *
   * @param {Partial<typeof DEFAULTS>} settings
   */
  set(settings) {
    Object.assign(this.settings, settings);
    this.look();
    this.invalidate();
  }

  look() {
    if (this.camera === null || this.worker === undefined) return;
    const { tolerance, fade } = this.settings;
    const budget = Math.min(this.settings.budget, this.renderer.mostGaussians);
    this.isSettled = false;
    const request = { camera: this.camera, budget, tolerance, fade };
    this.send({ type: "look", request });
  }

  /** Draw a frame soon. A still camera draws none. */
  invalidate() {
    if (this.request !== 0 || this.isClosed) return;
    this.request = requestAnimationFrame(() => {
      this.request = 0;
      this.draw();
    });
  }

  draw() {
    const { renderer, camera, instances, settings } = this;
    if (camera === null || instances === null || renderer.cut === null) return;
    renderer.drawCanvas(camera, instances, settings.background);
    this.numFrames += 1;
    if (this.hasPicture) return;
    this.hasPicture = true;
    renderer.device.queue.onSubmittedWorkDone().then(() => this.emit("firstpicture"));
  }

  /** Return the picture of the present cut, height * width * 4 numbers. */
  picture() {
    return this.renderer.pictureOf(this.camera, this.instances, this.settings.background);
  }

  /** Release the worker and the device. */
  close() {
    this.isClosed = true;
    cancelAnimationFrame(this.request);
    this.worker.terminate();
    this.renderer.destroy();
  }
}

/**
 * Return the centre and the radius of a ball around all instances.
 *
 * @param {Instances} instances
 * @param {Float32Array[]} balls Centre and radius of each bundle.
 */
function ballAround(instances, balls) {
  const low = [Infinity, Infinity, Infinity];
  const high = [-Infinity, -Infinity, -Infinity];
  instances.bundle.forEach((bundle, i) => {
    const [x, y, z, radius] = balls[bundle];
    const [qw, qx, qy, qz] = instances.quaternions.subarray(4 * i, 4 * i + 4);
    const rotation = rotationOf(qw, qx, qy, qz);
    const scale = instances.scales[i];
    for (let a = 0; a < 3; a += 1) {
      const [rx, ry, rz] = rotation.slice(3 * a, 3 * a + 3);
      const center = scale * (rx * x + ry * y + rz * z) + instances.positions[3 * i + a];
      low[a] = Math.min(low[a], center - scale * radius);
      high[a] = Math.max(high[a], center + scale * radius);
    }
  });
  const middle = low.map((value, a) => (value + high[a]) / 2);
  return [...middle, Math.hypot(...low.map((value, a) => high[a] - value)) / 2];
}

/**
 * Show a scene file or a bundle on a canvas.
 *
 * @param {HTMLCanvasElement} canvas
 * @param {string} url Of a .json or .v3dg file, relative to the page.
 * @param {Partial<typeof DEFAULTS>} options
 */
export async function open(canvas, url, options = {}) {
  const viewer = new Viewer(canvas, url, options);
  await viewer.start();
  return viewer;
}

export { NoDevice };
