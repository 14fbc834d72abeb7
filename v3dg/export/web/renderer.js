// Draws cuts with WebGPU: gaussians are decoded and projected (project.wgsl), sorted by
// depth (sort.wgsl), listed for each tile of the picture (tiles.wgsl, sort.wgsl), and
// blended tile by tile (draw.wgsl). v3dg/render/webgpu does the same in Python.

import {
  BYTES_OF_SIZES,
  DEPTH_PASSES,
  DEPTH_SIDES,
  DIGITS,
  FrameBuffers,
  GAUSSIANS_OF_WORKGROUP,
  KEYS_OF_TILE,
  MOST_TILES,
  PAIRS_OF_WORKGROUP,
  TILE_PASSES,
  TILE_SIDES,
} from "./frame_buffers.js";
import { PICTURE_FORMAT, Pipelines } from "./pipelines.js";
import { cameraBlock, placementsOf } from "./placement.js";

/** @typedef {import("./placement.js").Instances} Instances */
/** @typedef {import("./placement.js").Pinhole} Pinhole */
/**
 * @typedef {object} Cut What is drawn, in the layout of project.wgsl.
 * @property {number} count Gaussians.
 * @property {Uint32Array} pairs WORDS_OF_PAIR words for each cluster and instance.
 * @property {Uint32Array} firstPairs Pair of the first gaussian of each workgroup.
 * @property {Int32Array} instances The instances that pairs refer to.
 */
/**
 * @typedef {object} Sort
 * @property {string} uniforms
 * @property {number} numPasses Each moves keys and values to the other side.
 * @property {string[][]} sides Keys and values.
 * @property {string} sizes
 * @property {number} most Largest number of keys.
 */

export { GAUSSIANS_OF_WORKGROUP };
export const WORDS_OF_PAIR = 8;
const SIDE_OF_TILE = 16;
const NOT_DRAWN = 0xffffffff;
const BYTES_OF_PIXEL = 16;
const ROW_ALIGNMENT = 256;
/** Place of `num_items` in Sizes of shared.wgsl. */
const WORD_OF_ITEMS = 3;
/** As `v3dg.render` draws cuts up to the default tolerance. */
const MIN_TRANSMITTANCE = 1e-4;

/** The browser or the device cannot draw. The message is for users. */
export class NoDevice extends Error {}

/** @returns {Promise<GPUDevice>} */
async function requestDevice() {
  const { gpu } = navigator;
  const advice = "use a recent Chrome, Edge, Safari or Firefox, and https or localhost";
  if (!gpu) throw new NoDevice(`WebGPU: this browser does not have it; ${advice}`);
  const adapter = await gpu.requestAdapter({ powerPreference: "high-performance" });
  if (!adapter) throw new NoDevice("WebGPU: no graphics device is available to this browser");
  const { maxStorageBufferBindingSize, maxBufferSize } = adapter.limits;
  return adapter.requestDevice({
    requiredLimits: { maxStorageBufferBindingSize, maxBufferSize },
  });
}

/** @param {Pinhole} camera */
function tilesOf({ width, height }) {
  return [Math.ceil(width / SIDE_OF_TILE), Math.ceil(height / SIDE_OF_TILE)];
}

/**
 * Return whether a picture is small enough to be drawn.
 *
 * @param {number} width
 * @param {number} height
 */
export function isDrawable(width, height) {
  return Math.ceil(width / SIDE_OF_TILE) * Math.ceil(height / SIDE_OF_TILE) <= MOST_TILES;
}

export class Renderer {
  /**
   * @param {HTMLCanvasElement | OffscreenCanvas} canvas
   * @param {number} poolBytes Memory for pages. The device may have less.
   */
  static async create(canvas, poolBytes) {
    const device = await requestDevice();
    const renderer = new Renderer(device, canvas, poolBytes);
    renderer.pipelines = await Pipelines.create(device);
    renderer.finishCanvas = await renderer.pipelines.finishing(renderer.canvasFormat);
    return renderer;
  }

  /**
   * @param {GPUDevice} device
   * @param {HTMLCanvasElement | OffscreenCanvas} canvas
   * @param {number} poolBytes
   */
  constructor(device, canvas, poolBytes) {
    this.device = device;
    this.canvas = canvas;
    const { maxStorageBufferBindingSize, maxBufferSize } = device.limits;
    const mostBytes = Math.min(maxStorageBufferBindingSize, maxBufferSize);
    this.poolBytes = Math.min(poolBytes, mostBytes);
    this.canvasFormat = navigator.gpu.getPreferredCanvasFormat();
    this.context = /** @type {GPUCanvasContext} */ (canvas.getContext("webgpu"));
    this.context.configure({ device, format: this.canvasFormat, alphaMode: "opaque" });
    const { STORAGE, COPY_DST } = GPUBufferUsage;
    this.pool = device.createBuffer({ size: this.poolBytes, usage: STORAGE | COPY_DST });
    this.buffers = new FrameBuffers(device, mostBytes);
    /** @type {Cut} */
    this.cut = null;
    /** @type {GPUTexture} */
    this.picture = null;
    /** Whether checkPairs() is under way, and whether a picture was drawn meanwhile. */
    this.isChecking = false;
    this.isUnchecked = false;
    /** Is called when the last picture must be drawn again, with larger buffers. */
    this.onGrown = () => {};
    /** Is called with the number of pairs of a picture for which no buffers suffice. */
    this.onLimit = (/** @type {number} */ _numPairs) => {};
  }

  /** Bytes of all buffers and pictures. */
  get memoryBytes() {
    let bytes = this.pool.size + this.buffers.bytes;
    if (this.picture !== null) bytes += BYTES_OF_PIXEL * this.picture.width * this.picture.height;
    return bytes;
  }

  /** Largest number of gaussians of a cut. */
  get mostGaussians() {
    return this.buffers.mostGaussians;
  }

  /**
   * Write a page to the pool.
   *
   * @param {number} offset First byte, a multiple of 4.
   * @param {Uint8Array} bytes
   */
  writePage(offset, bytes) {
    this.device.queue.writeBuffer(this.pool, offset, bytes);
  }

  /**
   * Set what draw() draws.
   *
   * @param {Cut} cut
   */
  setCut(cut) {
    this.cut = cut;
    this.buffers.reserve(cut.count);
    this.buffers.upload("pairs", cut.pairs);
    this.buffers.upload("firstPairs", cut.firstPairs);
    this.buffers.setCount(cut.count);
  }

  /**
   * Draw the cut as a camera sees it on the canvas.
   *
   * @param {Pinhole} camera
   * @param {Instances} instances
   * @param {number[]} background Red, green and blue, 0 to 1.
   */
  drawCanvas(camera, instances, background) {
    const { canvas } = this;
    if (canvas.width !== camera.width) canvas.width = camera.width;
    if (canvas.height !== camera.height) canvas.height = camera.height;
    this.drawTo(this.context.getCurrentTexture(), this.finishCanvas, camera, instances, background);
    this.checkPairs();
  }

  /** Return the number of pairs of gaussians and tiles in the last picture. */
  async numPairs() {
    const { MAP_READ, COPY_DST } = GPUBufferUsage;
    const usage = MAP_READ | COPY_DST;
    const buffer = this.device.createBuffer({ size: BYTES_OF_SIZES, usage });
    const encoder = this.device.createCommandEncoder();
    const [sizes] = this.buffers.get("pairSizes");
    encoder.copyBufferToBuffer(sizes, 0, buffer, 0, BYTES_OF_SIZES);
    this.device.queue.submit([encoder.finish()]);
    await buffer.mapAsync(GPUMapMode.READ);
    const numPairs = new Uint32Array(buffer.getMappedRange())[WORD_OF_ITEMS];
    buffer.destroy();
    if (numPairs > this.buffers.mostPairs) this.onLimit(numPairs);
    return numPairs;
  }

  /** Enlarge the buffers if the last picture had more pairs than they have room for. */
  async checkPairs() {
    this.isUnchecked = true;
    if (this.isChecking) return;
    this.isChecking = true;
    let hasGrown = false;
    try {
      while (this.isUnchecked) {
        this.isUnchecked = false;
        hasGrown = this.buffers.reservePairs(await this.numPairs()) || hasGrown;
      }
    } catch {
      return; // The device is lost, and with it this renderer.
    }
    this.isChecking = false;
    if (hasGrown) this.onGrown();
  }

  /**
   * Return the picture of a camera, height * width * 4 numbers.
   *
   * @param {Pinhole} camera
   * @param {Instances} instances
   * @param {number[]} background
   */
  async pictureOf(camera, instances, background) {
    const { device } = this;
    const { COPY_SRC, RENDER_ATTACHMENT } = GPUTextureUsage;
    const size = [camera.width, camera.height];
    const format = "rgba32float";
    const texture = device.createTexture({ size, format, usage: COPY_SRC | RENDER_ATTACHMENT });
    const finish = await this.pipelines.finishing(format);
    do {
      this.drawTo(texture, finish, camera, instances, background);
    } while (this.buffers.reservePairs(await this.numPairs()));
    const bytesPerRow = Math.ceil((BYTES_OF_PIXEL * camera.width) / ROW_ALIGNMENT) * ROW_ALIGNMENT;
    const { MAP_READ, COPY_DST } = GPUBufferUsage;
    const usage = MAP_READ | COPY_DST;
    const buffer = device.createBuffer({ size: bytesPerRow * camera.height, usage });
    const encoder = device.createCommandEncoder();
    encoder.copyTextureToBuffer({ texture }, { buffer, bytesPerRow }, size);
    device.queue.submit([encoder.finish()]);
    await buffer.mapAsync(GPUMapMode.READ);
    const rows = buffer.getMappedRange();
    const picture = new Float32Array(4 * camera.width * camera.height);
    for (let y = 0; y < camera.height; y += 1) {
      const row = new Float32Array(rows, bytesPerRow * y, 4 * camera.width);
      picture.set(row, 4 * camera.width * y);
    }
    buffer.destroy();
    texture.destroy();
    return picture;
  }

  /**
   * @param {GPUTexture} target
   * @param {GPURenderPipeline} finish
   * @param {Pinhole} camera
   * @param {Instances} instances
   * @param {number[]} background
   */
  drawTo(target, finish, camera, instances, background) {
    const { device, cut } = this;
    const count = cut?.count ?? 0;
    const [cameraBuffer, sizes, pairSizes, ranges] = this.buffers.get(
      "camera",
      "sizes",
      "pairSizes",
      "ranges",
    );
    const block = cameraBlock(camera, count, background, MIN_TRANSMITTANCE);
    device.queue.writeBuffer(cameraBuffer, 0, block);
    device.queue.writeBuffer(sizes, 0, Uint32Array.of(count, NOT_DRAWN, 0, 0));
    device.queue.writeBuffer(pairSizes, 0, new Uint32Array(4));
    this.resize(camera);
    const encoder = device.createCommandEncoder();
    encoder.clearBuffer(ranges);
    const pass = encoder.beginComputePass();
    if (count > 0) {
      this.buffers.upload("placements", placementsOf(camera, instances, cut.instances));
      this.encodeOrder(pass, count);
      this.encodeTiles(pass, count);
    }
    this.encodePicture(pass, camera);
    pass.end();
    this.encodeFinish(encoder, target, finish);
    device.queue.submit([encoder.finish()]);
  }

  /**
   * Project the gaussians of the cut and sort them by depth.
   *
   * @param {GPUComputePassEncoder} pass
   * @param {number} count
   */
  encodeOrder(pass, count) {
    const { pipelines, buffers } = this;
    const [camera] = buffers.get("camera");
    const inputs = buffers.get("pairs", "firstPairs", "placements");
    const outputs = buffers.get("records", "keys", "sizes");
    pass.setPipeline(pipelines.project);
    const resources = [camera, this.pool, ...inputs, ...outputs];
    pass.setBindGroup(0, pipelines.bind("projecting", resources));
    pass.dispatchWorkgroups(Math.ceil(count / GAUSSIANS_OF_WORKGROUP));
    this.encodeSort(pass, {
      uniforms: "depthPasses",
      numPasses: DEPTH_PASSES,
      sides: DEPTH_SIDES,
      sizes: "sizes",
      most: count,
    });
  }

  /**
   * List the pairs of gaussians and tiles, and sort them by tile.
   *
   * @param {GPUComputePassEncoder} pass
   * @param {number} count Gaussians.
   */
  encodeTiles(pass, count) {
    const { pipelines, buffers } = this;
    const [, order] = DEPTH_SIDES[DEPTH_PASSES % 2];
    const inputs = buffers.get("camera", "records", order, "sizes");
    const outputs = buffers.get("blocks", ...TILE_SIDES[0], "pairSizes");
    pass.setBindGroup(0, pipelines.bind("listing", [...inputs, ...outputs]));
    const numBlocks = Math.ceil(count / GAUSSIANS_OF_WORKGROUP);
    pass.setPipeline(pipelines.countPairs);
    pass.dispatchWorkgroups(numBlocks);
    pass.setPipeline(pipelines.sumBlocks);
    pass.dispatchWorkgroups(1);
    pass.setPipeline(pipelines.writePairs);
    pass.dispatchWorkgroups(numBlocks);
    this.encodeSort(pass, {
      uniforms: "tilePasses",
      numPasses: TILE_PASSES,
      sides: TILE_SIDES,
      sizes: "pairSizes",
      most: buffers.pairCapacity,
    });
    pass.setPipeline(pipelines.findRanges);
    pass.setBindGroup(0, pipelines.bind("finding", buffers.get("tiles", "pairSizes", "ranges")));
    pass.dispatchWorkgroups(Math.ceil(buffers.pairCapacity / PAIRS_OF_WORKGROUP));
  }

  /**
   * Sort keys with values.
   *
   * @param {GPUComputePassEncoder} pass
   * @param {Sort} sort
   */
  encodeSort(pass, { uniforms, numPasses, sides, sizes, most }) {
    const { pipelines, buffers } = this;
    const numTiles = Math.ceil(most / KEYS_OF_TILE);
    for (let k = 0; k < numPasses; k += 1) {
      const names = [...sides[k % 2], ...sides[1 - (k % 2)], "counts", "totals", sizes];
      const resources = [buffers.passOf(uniforms, k), ...buffers.get(...names)];
      pass.setBindGroup(0, pipelines.bind("sorting", resources));
      pass.setPipeline(pipelines.countDigits);
      pass.dispatchWorkgroups(numTiles);
      pass.setPipeline(pipelines.sumCounts);
      pass.dispatchWorkgroups(DIGITS);
      pass.setPipeline(pipelines.moveKeys);
      pass.dispatchWorkgroups(numTiles);
    }
  }

  /**
   * Blend the gaussians of each tile.
   *
   * @param {GPUComputePassEncoder} pass
   * @param {Pinhole} camera
   */
  encodePicture(pass, camera) {
    const { pipelines, buffers } = this;
    const [, gaussians] = TILE_SIDES[TILE_PASSES % 2];
    const inputs = buffers.get("camera", "records", gaussians, "ranges");
    const resources = [...inputs, this.picture.createView()];
    pass.setPipeline(pipelines.blend);
    pass.setBindGroup(0, pipelines.bind("blending", resources));
    const [columns, rows] = tilesOf(camera);
    pass.dispatchWorkgroups(columns, rows);
  }

  /**
   * Put the picture over the background.
   *
   * @param {GPUCommandEncoder} encoder
   * @param {GPUTexture} target
   * @param {GPURenderPipeline} finish
   */
  encodeFinish(encoder, target, finish) {
    const pass = encoder.beginRenderPass({
      colorAttachments: [{ view: target.createView(), loadOp: "clear", storeOp: "store" }],
    });
    pass.setPipeline(finish);
    const resources = [...this.buffers.get("camera"), this.picture.createView()];
    pass.setBindGroup(0, this.pipelines.bindFinishing(finish, resources));
    pass.draw(3);
    pass.end();
  }

  /**
   * Make a picture of the size of the camera, unless it has that size.
   *
   * @param {Pinhole} camera
   */
  resize({ width, height }) {
    if (this.picture?.width === width && this.picture?.height === height) return;
    this.picture?.destroy();
    this.picture = this.device.createTexture({
      size: [width, height],
      format: PICTURE_FORMAT,
      usage: GPUTextureUsage.STORAGE_BINDING | GPUTextureUsage.TEXTURE_BINDING,
    });
  }

  /** Release the device. */
  destroy() {
    this.device.destroy();
  }
}
