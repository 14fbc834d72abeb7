// The worker of a viewer: opens the scene, selects the cut of each view, and reads the
// pages that cuts need. Messages are listed in viewer.js.

import { BundleFile } from "./bundle_file.js";
import { Bundle, Core, Scene } from "./core.js";
import { layOut } from "./layout.js";
import { ARRIVAL_FRAMES, PagePool } from "./page_pool.js";
import { readScene } from "./scene_file.js";
import { UserError, Source, Unreachable } from "./source.js";

/** @typedef {import("./page_pool.js").Wanted} Wanted */
/** @typedef {import("./placement.js").Instances} Instances */
/** @typedef {import("./placement.js").Pinhole} Pinhole */
/** @typedef {{ bundle: number, page: number, bytes: Uint8Array }} Loaded */
/**
 * @typedef {object} Request
 * @property {Pinhole} camera
 * @property {number} budget Most gaussians.
 * @property {number} tolerance px² a gaussian.
 * @property {number} fade
 */

const FRAME_MS = 16;
const MOST_READS = 6;
/** Neighbouring pages are read together up to this many bytes. */
const READ_BYTES = 2 ** 18;
const FIRST_WAIT_MS = 500;
const MOST_WAIT_MS = 15_000;
/** Frames until a budget's tolerance is that of a still view (csrc/select/budget_math.h). */
const REST_FRAMES = 8;
/** Pages that wait for a slot, or for the page above them. */
const MOST_LOADED = 64;

/** @param {number} ms */
function waiting(ms) {
  return new Promise((resolve) => {
    setTimeout(resolve, ms);
  });
}

class World {
  /** @type {Request} */
  request = null;
  frame = 0;
  framesAtRest = 0;
  isScheduled = false;
  isSettled = false;
  /** Reads that have begun, by bundle and page. @type {Set<string>} */
  reading = new Set();
  numReads = 0;
  /** Pages that were read, and are not resident. @type {Loaded[]} */
  loaded = [];
  /** @type {Wanted[]} */
  wanted = [];
  /** Bundles of which nothing more is read. @type {Set<number>} */
  frozen = new Set();

  /**
   * @param {Core} core
   * @param {BundleFile[]} files
   * @param {Instances} instances
   * @param {number} poolBytes
   */
  constructor(core, files, instances, poolBytes) {
    this.core = core;
    this.files = files;
    this.instances = instances;
    this.pool = new PagePool(files, poolBytes);
    this.bundles = files.map(({ tables }, k) => {
      const { shift, begins } = this.pool.pages[k];
      const needs = new Uint32Array(shift.length);
      return new Bundle(core, { ...tables, level: tables.groupLevel, shift, begins, needs });
    });
    this.scene = new Scene(core, this.bundles);
    this.scene.setInstances(instances);
  }

  get receivedBytes() {
    return this.files.reduce((sum, { source }) => sum + source.receivedBytes, 0);
  }

  /** Make the coarsest page of each bundle resident. */
  putRoots() {
    this.files.forEach(({ root }, bundle) => {
      postMessage({ type: "page", place: this.pool.putRoot(bundle), bytes: root });
    });
  }

  /** Empty the pool, because the device was lost. */
  reset() {
    this.pool = new PagePool(this.files, this.pool.bytes);
    this.loaded = [];
    this.putRoots();
    this.schedule(0);
  }

  /** @param {Request} request */
  look(request) {
    this.request = request;
    this.framesAtRest = 0;
    this.schedule(0);
  }

  /** @param {number} ms */
  schedule(ms) {
    if (this.isScheduled) return;
    this.isScheduled = true;
    setTimeout(() => {
      this.isScheduled = false;
      try {
        this.step();
      } catch (error) {
        report(error);
      }
    }, ms);
  }

  /** Select the cut of a frame, and begin to read what it needs. */
  step() {
    if (this.request === null) return;
    this.putLoaded();
    this.frame += 1;
    this.pool.pages.forEach((pages, k) => {
      if (!pages.hasChanged) return;
      this.bundles[k].setPages(pages.shift, pages.begins);
      pages.hasChanged = false;
    });
    const selection = this.select();
    const cut = layOut(selection, this.files, this.pool.places, this.instances);
    this.wanted = this.bundles.flatMap((bundle, k) =>
      this.pool.recordNeeds(k, bundle.takeNeeds(), this.frame),
    );
    this.wanted.sort((a, b) => b.priority - a.priority);
    this.read();
    const isAtRest = this.framesAtRest >= REST_FRAMES;
    const isFading = this.frame - this.pool.lastArrival <= ARRIVAL_FRAMES;
    const isReading = this.wanted.some(({ bundle }) => !this.frozen.has(bundle));
    const isFull = this.numReads === 0 && this.loaded.length > 0;
    const isSettled = isAtRest && !isFading && (!isReading || isFull);
    this.post(cut, selection.tolerance, isSettled);
    if (!isAtRest) this.framesAtRest += 1;
    if (isFading || !isAtRest) this.schedule(FRAME_MS);
  }

  select() {
    const { camera, budget, tolerance, fade } = this.request;
    const view = { ...camera, tolerance, fade, frame: this.frame, inSteps: true };
    const rule = { ...view, budget, framesAtRest: this.framesAtRest };
    const selection = this.scene.select(rule);
    if (selection.fitsBudget) return selection;
    return this.scene.select({ ...rule, budget: selection.numGaussians });
  }

  /**
   * @param {import("./renderer.js").Cut} cut
   * @param {number} tolerance Of the cut.
   * @param {boolean} isSettled Whether nothing will change while the camera is still.
   */
  post(cut, tolerance, isSettled) {
    postMessage(
      {
        type: "cut",
        cut,
        tolerance,
        isSettled,
        missing: this.wanted.length,
        receivedBytes: this.receivedBytes,
      },
      { transfer: [cut.pairs.buffer, cut.firstPairs.buffer, cut.instances.buffer] },
    );
  }

  /** Make pages resident that were read. Pages that nothing needs any more are dropped. */
  putLoaded() {
    const urgency = new Map(this.wanted.map((one) => [keyOf(one), one.priority]));
    const left = this.loaded.filter((one) => urgency.has(keyOf(one)));
    left.sort((a, b) => urgency.get(keyOf(b)) - urgency.get(keyOf(a)));
    this.loaded = left.filter(({ bundle, page, bytes }) => {
      if (!this.pool.mayPut(bundle, page)) {
        return !this.frozen.has(bundle) && !this.pool.pages[bundle].isResident(page);
      }
      const place = this.pool.put(bundle, page, this.frame);
      if (place < 0) return true;
      postMessage({ type: "page", place, bytes });
      return false;
    });
  }

  /** Begin to read the most urgent pages. */
  read() {
    const known = new Set([...this.reading, ...this.loaded.map(keyOf)]);
    const open = this.wanted.filter(
      (one) => !known.has(keyOf(one)) && !this.frozen.has(one.bundle),
    );
    const keys = new Set(open.map(keyOf));
    for (const { bundle, page } of open) {
      if (this.numReads >= MOST_READS || this.loaded.length >= MOST_LOADED) return;
      if (!keys.has(keyOf({ bundle, page }))) continue;
      const file = this.files[bundle];
      let end = page;
      let bytes = 0;
      do {
        keys.delete(keyOf({ bundle, page: end }));
        bytes += file.bytesOf(end);
        end += 1;
      } while (keys.has(keyOf({ bundle, page: end })) && bytes < READ_BYTES);
      this.readPages(bundle, page, end);
    }
  }

  /**
   * @param {number} bundle
   * @param {number} first
   * @param {number} end
   */
  async readPages(bundle, first, end) {
    const file = this.files[bundle];
    const keys = Array.from({ length: end - first }, (_, k) => keyOf({ bundle, page: first + k }));
    this.numReads += 1;
    keys.forEach((key) => this.reading.add(key));
    try {
      const pages = await retrying(() => file.readPages(first, end));
      pages.forEach((bytes, k) => {
        file.verify(this.core, first + k, bytes);
        this.loaded.push({ bundle, page: first + k, bytes: bytes.slice() });
      });
    } catch (error) {
      this.frozen.add(bundle);
      report(error);
    }
    this.numReads -= 1;
    keys.forEach((key) => this.reading.delete(key));
    this.schedule(FRAME_MS);
  }
}

/** @param {{ bundle: number, page: number }} one */
function keyOf({ bundle, page }) {
  return `${bundle}/${page}`;
}

/**
 * Try to read until the server answers.
 *
 * @template T
 * @param {() => Promise<T>} read
 */
async function retrying(read) {
  let wait = FIRST_WAIT_MS;
  for (;;) {
    try {
      const result = await read();
      if (wait > FIRST_WAIT_MS) postMessage({ type: "notice", text: "" });
      return result;
    } catch (error) {
      if (!(error instanceof Unreachable)) throw error;
      postMessage({ type: "notice", text: error.message });
      await waiting(wait);
      wait = Math.min(2 * wait, MOST_WAIT_MS);
    }
  }
}

/** @param {unknown} error */
function report(error) {
  if (error instanceof UserError) {
    postMessage({ type: "notice", text: error.message });
    return;
  }
  postMessage({ type: "failure", text: `v3dg: the worker has stopped: ${error}; reload the page` });
}

/**
 * Return the files of a scene that can be opened, and the instances of those.
 *
 * @param {string[]} urls
 * @param {Instances} instances
 * @param {WebAssembly.Module} module The core.
 */
async function openFiles(urls, instances, module) {
  const core = await Core.load(module);
  const opened = await Promise.all(
    urls.map(async (url) => {
      try {
        const source = new Source(url);
        const file = await retrying(() => BundleFile.open(source, () => Core.load(module)));
        await retrying(() => file.readRoot(core));
        return file;
      } catch (error) {
        if (!(error instanceof UserError)) throw error;
        report(error);
        return null;
      }
    }),
  );
  const files = opened.filter((file) => file !== null);
  const indices = opened.map((file) => files.indexOf(file));
  const used = [...instances.bundle.keys()].filter((i) => indices[instances.bundle[i]] >= 0);
  return { files, instances: subsetOf(instances, used, indices) };
}

/**
 * @param {Instances} all
 * @param {number[]} used
 * @param {number[]} indices Index of each bundle in the subset.
 * @returns {Instances}
 */
function subsetOf(all, used, indices) {
  const rows = (/** @type {ArrayLike<number>} */ values, /** @type {number} */ width) =>
    used.flatMap((i) => Array.from({ length: width }, (_, k) => values[width * i + k]));
  return {
    bundle: Int32Array.from(used, (i) => indices[all.bundle[i]]),
    positions: Float64Array.from(rows(all.positions, 3)),
    quaternions: Float64Array.from(rows(all.quaternions, 4)),
    scales: Float64Array.from(rows(all.scales, 1)),
    importance: Float32Array.from(rows(all.importance, 1)),
    factors: Float32Array.from(rows(all.factors, 4)),
  };
}

/** @type {World} */
let world = null;

/**
 * @param {string} url
 * @param {number} poolBytes
 */
async function openWorld(url, poolBytes) {
  const response = await fetch(new URL("core.wasm", import.meta.url));
  if (!response.ok) throw new UserError(`core.wasm: the server answered ${response.status}`);
  const module = await WebAssembly.compile(await response.arrayBuffer());
  const { urls, instances: all, cameras, up } = await readScene(url);
  const { files, instances } = await openFiles(urls, all, module);
  if (files.length === 0) return;
  world = new World(await Core.load(module), files, instances, poolBytes);
  const balls = files.map(({ tables }) => tables.ball.slice(-4));
  postMessage({ type: "opened", instances, cameras, up, balls });
  world.putRoots();
}

/** @type {Request} */
let lastRequest = null;

addEventListener("message", async ({ data }) => {
  try {
    if (data.type === "open") {
      await openWorld(data.url, data.poolBytes);
      if (world !== null && lastRequest !== null) world.look(lastRequest);
    } else if (data.type === "look") {
      lastRequest = data.request;
      world?.look(data.request);
    } else if (data.type === "reset") {
      world?.reset();
    }
  } catch (error) {
    report(error);
  }
});
