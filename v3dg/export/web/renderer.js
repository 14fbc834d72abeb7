// Draws cuts with WebGPU: gaussians are decoded and projected, sorted by depth, and
// blended as quads from back to front (project.wgsl, sort.wgsl, draw.wgsl).

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

export const WORDS_OF_PAIR = 8;
export const GAUSSIANS_OF_WORKGROUP = 256;
const KEYS_OF_TILE = 2048;
const DIGITS = 16;
const NUM_PASSES = 7;
const BYTES_OF_RECORD = 32;
const BYTES_OF_ARGUMENTS = 16;
/** Distance between the uniforms of sorting passes: the alignment that devices need. */
const UNIFORM_STRIDE = 256;
const PICTURE_FORMAT = "rgba16float";
const LEAST_CAPACITY = 1 << 14;

const OVER = /** @type {const} */ ({
  srcFactor: "one",
  dstFactor: "one-minus-src-alpha",
  operation: "add",
});

/** The bindings of sort.wgsl, which all of its pipelines share. */
function sortEntries() {
  const read = "read-only-storage";
  const types = /** @type {const} */ (["uniform", read, read, "storage", "storage", "storage"]);
  const visibility = GPUShaderStage.COMPUTE;
  return types.map((type, binding) => ({ binding, visibility, buffer: { type } }));
}

/** The browser or the device cannot draw. The message is for users. */
export class NoDevice extends Error {}

/**
 * @param {string} name
 * @returns {Promise<string>}
 */
async function shaderText(name) {
  const response = await fetch(new URL(name, import.meta.url));
  if (!response.ok) throw new Error(`${name}: the server answered ${response.status}`);
  return response.text();
}

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

export class Renderer {
  /**
   * @param {HTMLCanvasElement | OffscreenCanvas} canvas
   * @param {number} poolBytes Memory for pages. The device may have less.
   */
  static async create(canvas, poolBytes) {
    const device = await requestDevice();
    const names = ["shared.wgsl", "project.wgsl", "sort.wgsl", "draw.wgsl"];
    const [shared, project, sort, draw] = await Promise.all(names.map(shaderText));
    const compiled = (/** @type {string} */ code) => device.createShaderModule({ code });
    const renderer = new Renderer(device, canvas, poolBytes);
    await renderer.makePipelines(
      compiled(shared + project),
      compiled(sort),
      compiled(shared + draw),
    );
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
    this.mostBytes = Math.min(maxStorageBufferBindingSize, maxBufferSize);
    this.poolBytes = Math.min(poolBytes, this.mostBytes);
    this.canvasFormat = navigator.gpu.getPreferredCanvasFormat();
    this.context = /** @type {GPUCanvasContext} */ (canvas.getContext("webgpu"));
    this.context.configure({ device, format: this.canvasFormat, alphaMode: "opaque" });
    const { STORAGE, COPY_DST, UNIFORM, INDIRECT } = GPUBufferUsage;
    this.pool = this.buffer(this.poolBytes, STORAGE | COPY_DST);
    this.camera = this.buffer(64, UNIFORM | COPY_DST);
    this.arguments = this.buffer(BYTES_OF_ARGUMENTS, STORAGE | INDIRECT | COPY_DST);
    this.passes = this.buffer(NUM_PASSES * UNIFORM_STRIDE, UNIFORM | COPY_DST);
    /** Buffers for the cut, by name, which grow. @type {Map<string, GPUBuffer>} */
    this.buffers = new Map();
    /** Largest number of gaussians that the buffers have room for. */
    this.capacity = 0;
    /** @type {Cut} */
    this.cut = null;
    /** @type {GPUTexture} */
    this.picture = null;
    this.reserve(LEAST_CAPACITY);
  }

  /** Bytes of all buffers and pictures. */
  get memoryBytes() {
    let bytes = this.pool.size;
    for (const buffer of this.buffers.values()) bytes += buffer.size;
    if (this.picture !== null) bytes += 8 * this.picture.width * this.picture.height;
    return bytes;
  }

  /** Largest number of gaussians of a cut. */
  get mostGaussians() {
    return Math.floor(this.mostBytes / BYTES_OF_RECORD);
  }

  /**
   * @param {number} size
   * @param {number} usage
   */
  buffer(size, usage) {
    return this.device.createBuffer({ size, usage });
  }

  /**
   * @param {GPUShaderModule} project
   * @param {GPUShaderModule} sort
   * @param {GPUShaderModule} draw
   */
  async makePipelines(project, sort, draw) {
    const { device } = this;
    this.drawModule = draw;
    this.sortLayout = device.createBindGroupLayout({ entries: sortEntries() });
    const layout = device.createPipelineLayout({ bindGroupLayouts: [this.sortLayout] });
    const sorting = (/** @type {string} */ entryPoint) =>
      device.createComputePipelineAsync({ layout, compute: { module: sort, entryPoint } });
    const projecting = { module: project, entryPoint: "project" };
    [this.project, this.countDigits, this.sumCounts, this.moveKeys, this.draw] = await Promise.all([
      device.createComputePipelineAsync({ layout: "auto", compute: projecting }),
      sorting("count_digits"),
      sorting("sum_counts"),
      sorting("move_keys"),
      device.createRenderPipelineAsync({
        layout: "auto",
        vertex: { module: draw, entryPoint: "draw_corner" },
        fragment: {
          module: draw,
          entryPoint: "draw_pixel",
          targets: [{ format: PICTURE_FORMAT, blend: { color: OVER, alpha: OVER } }],
        },
        primitive: { topology: "triangle-strip" },
      }),
    ]);
    this.finishCanvas = await this.finishing(this.canvasFormat);
  }

  /**
   * @param {GPUTextureFormat} format Of the finished picture.
   */
  finishing(format) {
    return this.device.createRenderPipelineAsync({
      layout: "auto",
      vertex: { module: this.drawModule, entryPoint: "cover" },
      fragment: { module: this.drawModule, entryPoint: "finish", targets: [{ format }] },
    });
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
   * Enlarge the buffers, if necessary, for a number of gaussians.
   *
   * @param {number} count
   */
  reserve(count) {
    if (count <= this.capacity) return;
    this.capacity = Math.min(
      Math.max(count, LEAST_CAPACITY, 1.25 * this.capacity),
      this.mostGaussians,
    );
    this.capacity = Math.ceil(this.capacity);
    const { STORAGE } = GPUBufferUsage;
    this.replace("records", BYTES_OF_RECORD * this.capacity, STORAGE);
    for (const name of ["keys", "values", "otherKeys", "otherValues"]) {
      this.replace(name, 4 * this.capacity, STORAGE);
    }
    this.replace("counts", 4 * DIGITS * Math.ceil(this.capacity / KEYS_OF_TILE), STORAGE);
  }

  /**
   * @param {string} name
   * @param {number} bytes
   * @param {number} usage
   */
  replace(name, bytes, usage) {
    this.buffers.get(name)?.destroy();
    this.buffers.set(name, this.buffer(bytes, usage));
  }

  /**
   * Write an array to a buffer, which grows to hold it.
   *
   * @param {string} name
   * @param {Uint32Array | Float32Array} array
   */
  upload(name, array) {
    const bytes = Math.max(array.byteLength, 16);
    if ((this.buffers.get(name)?.size ?? 0) < bytes) {
      this.replace(
        name,
        4 * Math.ceil(bytes / 3),
        GPUBufferUsage.STORAGE | GPUBufferUsage.COPY_DST,
      );
    }
    this.device.queue.writeBuffer(this.buffers.get(name), 0, array);
  }

  /**
   * Set what draw() draws.
   *
   * @param {Cut} cut
   */
  setCut(cut) {
    this.cut = cut;
    this.reserve(cut.count);
    this.upload("pairs", cut.pairs);
    this.upload("firstPairs", cut.firstPairs);
    const numTiles = Math.ceil(cut.count / KEYS_OF_TILE);
    const passes = new Uint32Array((NUM_PASSES * UNIFORM_STRIDE) / 4);
    for (let pass = 0; pass < NUM_PASSES; pass += 1) {
      passes.set([cut.count, 4 * pass, numTiles], (pass * UNIFORM_STRIDE) / 4);
    }
    this.device.queue.writeBuffer(this.passes, 0, passes);
  }

  /**
   * @param {GPUBindGroupLayout} layout
   * @param {(GPUBuffer | GPUBufferBinding | GPUTextureView)[]} resources
   * @param {number[]} bindings Their numbers; from 0 on if absent.
   */
  bind(layout, resources, bindings = resources.map((_, k) => k)) {
    const entries = resources.map((resource, k) => ({
      binding: bindings[k],
      resource: resource instanceof GPUBuffer ? { buffer: resource } : resource,
    }));
    return this.device.createBindGroup({ layout, entries });
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
    this.drawTo(texture, await this.finishing(format), camera, instances, background);
    const bytesPerRow = Math.ceil((16 * camera.width) / UNIFORM_STRIDE) * UNIFORM_STRIDE;
    const { MAP_READ, COPY_DST } = GPUBufferUsage;
    const buffer = this.buffer(bytesPerRow * camera.height, MAP_READ | COPY_DST);
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
    device.queue.writeBuffer(this.camera, 0, cameraBlock(camera, count, background));
    device.queue.writeBuffer(this.arguments, 0, Uint32Array.of(4, 0, 0, 0));
    const encoder = device.createCommandEncoder();
    if (count > 0) {
      this.upload("placements", placementsOf(camera, instances, cut.instances));
      this.encodeOrder(encoder, count);
    }
    this.encodePicture(encoder, camera, count);
    const pass = encoder.beginRenderPass({
      colorAttachments: [{ view: target.createView(), loadOp: "clear", storeOp: "store" }],
    });
    pass.setPipeline(finish);
    const resources = [this.camera, this.picture.createView()];
    pass.setBindGroup(0, this.bind(finish.getBindGroupLayout(0), resources, [0, 4]));
    pass.draw(3);
    pass.end();
    device.queue.submit([encoder.finish()]);
  }

  /**
   * Project the gaussians of the cut and sort them by depth.
   *
   * @param {GPUCommandEncoder} encoder
   * @param {number} count
   */
  encodeOrder(encoder, count) {
    const get = (/** @type {string} */ name) => this.buffers.get(name);
    const pass = encoder.beginComputePass();
    pass.setPipeline(this.project);
    const inputs = [this.camera, this.pool, get("pairs"), get("firstPairs"), get("placements")];
    const outputs = [get("records"), get("keys"), get("values"), this.arguments];
    pass.setBindGroup(0, this.bind(this.project.getBindGroupLayout(0), [...inputs, ...outputs]));
    pass.dispatchWorkgroups(Math.ceil(count / GAUSSIANS_OF_WORKGROUP));
    const numTiles = Math.ceil(count / KEYS_OF_TILE);
    const sides = [
      [get("keys"), get("values")],
      [get("otherKeys"), get("otherValues")],
    ];
    for (let k = 0; k < NUM_PASSES; k += 1) {
      const uniform = { buffer: this.passes, offset: k * UNIFORM_STRIDE, size: 16 };
      const resources = [uniform, ...sides[k % 2], ...sides[1 - (k % 2)], get("counts")];
      pass.setBindGroup(0, this.bind(this.sortLayout, resources));
      pass.setPipeline(this.countDigits);
      pass.dispatchWorkgroups(numTiles);
      pass.setPipeline(this.sumCounts);
      pass.dispatchWorkgroups(1);
      pass.setPipeline(this.moveKeys);
      pass.dispatchWorkgroups(numTiles);
    }
    pass.end();
  }

  /**
   * Blend the records in their order.
   *
   * @param {GPUCommandEncoder} encoder
   * @param {Pinhole} camera
   * @param {number} count
   */
  encodePicture(encoder, { width, height }, count) {
    if (this.picture?.width !== width || this.picture?.height !== height) {
      this.picture?.destroy();
      this.picture = this.device.createTexture({
        size: [width, height],
        format: PICTURE_FORMAT,
        usage: GPUTextureUsage.RENDER_ATTACHMENT | GPUTextureUsage.TEXTURE_BINDING,
      });
    }
    const pass = encoder.beginRenderPass({
      colorAttachments: [
        {
          view: this.picture.createView(),
          clearValue: [0, 0, 0, 0],
          loadOp: "clear",
          storeOp: "store",
        },
      ],
    });
    if (count > 0) {
      pass.setPipeline(this.draw);
      const resources = [
        this.camera,
        this.buffers.get("records"),
        this.buffers.get("otherValues"),
        this.arguments,
      ];
      pass.setBindGroup(0, this.bind(this.draw.getBindGroupLayout(0), resources));
      pass.drawIndirect(this.arguments, 0);
    }
    pass.end();
  }

  /** Release the device. */
  destroy() {
    this.device.destroy();
  }
}
