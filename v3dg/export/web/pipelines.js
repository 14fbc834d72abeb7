// The steps of a picture on the device: shaders, and the types of their bindings.

/** @typedef {GPUBuffer | GPUBufferBinding | GPUTextureView} Resource */
/** @typedef {(string | null)[]} Types Of the bindings; null for numbers without one. */

export const PICTURE_FORMAT = "rgba32float";
const SHADERS = ["shared.wgsl", "project.wgsl", "sort.wgsl", "tiles.wgsl", "draw.wgsl"];
const BUFFER_TYPES = /** @type {const} */ ({
  uniform: "uniform",
  read: "read-only-storage",
  write: "storage",
});

/** The bindings of each step. */
const TYPES = {
  projecting: ["uniform", "read", "read", "read", "read", "write", "write", "write"],
  sorting: ["uniform", "read", "read", "write", "write", "write", "write", "read"],
  listing: ["uniform", "read", "read", "read", "write", "write", "write", "write"],
  finding: [null, null, "read", null, "read", "write"],
  blending: ["uniform", "read", null, "read", null, null, "read", "picture"],
};
/** Binding of the picture in the last step, which is drawn to a texture. */
const FINISHING = ["uniform", null, null, null, null, null, null, null, "picture"];

/**
 * @param {string} name
 * @returns {Promise<string>}
 */
async function shaderText(name) {
  const response = await fetch(new URL(name, import.meta.url));
  if (!response.ok) throw new Error(`${name}: the server answered ${response.status}`);
  return response.text();
}

/**
 * @param {Types} types
 * @returns {number[]}
 */
function bindingsOf(types) {
  return [...types.keys()].filter((binding) => types[binding] !== null);
}

export class Pipelines {
  /** @param {GPUDevice} device */
  static async create(device) {
    const [shared, ...texts] = await Promise.all(SHADERS.map(shaderText));
    const modules = texts.map((text) => device.createShaderModule({ code: shared + text }));
    const pipelines = new Pipelines(device);
    await pipelines.compile(modules);
    return pipelines;
  }

  /** @param {GPUDevice} device */
  constructor(device) {
    this.device = device;
    /** Layout of the bindings of each step. @type {Map<string, GPUBindGroupLayout>} */
    this.layouts = new Map();
    for (const [name, types] of Object.entries(TYPES)) this.layouts.set(name, this.layout(types));
  }

  /** @param {GPUShaderModule[]} modules */
  async compile([project, sort, tiles, draw]) {
    this.drawModule = draw;
    const steps = await Promise.all([
      this.step("projecting", project, "project"),
      this.step("sorting", sort, "count_digits"),
      this.step("sorting", sort, "sum_counts"),
      this.step("sorting", sort, "move_keys"),
      this.step("listing", tiles, "count_pairs"),
      this.step("listing", tiles, "sum_blocks"),
      this.step("listing", tiles, "write_pairs"),
      this.step("finding", draw, "find_ranges"),
      this.step("blending", draw, "blend"),
    ]);
    [this.project, this.countDigits, this.sumCounts, this.moveKeys] = steps;
    [this.countPairs, this.sumBlocks, this.writePairs] = steps.slice(4);
    [this.findRanges, this.blend] = steps.slice(7);
  }

  /** @param {Types} types */
  layout(types) {
    /** @type {GPUBindGroupLayoutEntry[]} */
    const entries = [];
    const visibility = GPUShaderStage.COMPUTE;
    for (const binding of bindingsOf(types)) {
      const type = types[binding];
      if (type === "picture") {
        const storageTexture = { access: "write-only", format: PICTURE_FORMAT };
        entries.push({ binding, visibility, storageTexture });
      } else {
        entries.push({ binding, visibility, buffer: { type: BUFFER_TYPES[type] } });
      }
    }
    return this.device.createBindGroupLayout({ entries });
  }

  /**
   * @param {string} name Of the layout.
   * @param {GPUShaderModule} module
   * @param {string} entryPoint
   */
  step(name, module, entryPoint) {
    const bindGroupLayouts = [this.layouts.get(name)];
    const layout = this.device.createPipelineLayout({ bindGroupLayouts });
    return this.device.createComputePipelineAsync({ layout, compute: { module, entryPoint } });
  }

  /**
   * Return the pipeline that finishes a picture.
   *
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
   * Bind resources to the numbers of a step, in their order.
   *
   * @param {string} name Of the layout.
   * @param {Resource[]} resources
   */
  bind(name, resources) {
    return this.group(this.layouts.get(name), TYPES[name], resources);
  }

  /**
   * @param {GPURenderPipeline} pipeline Of finishing().
   * @param {Resource[]} resources
   */
  bindFinishing(pipeline, resources) {
    return this.group(pipeline.getBindGroupLayout(0), FINISHING, resources);
  }

  /**
   * @param {GPUBindGroupLayout} layout
   * @param {Types} types
   * @param {Resource[]} resources
   */
  group(layout, types, resources) {
    const bindings = bindingsOf(types);
    const entries = resources.map((resource, k) => ({
      binding: bindings[k],
      resource: resource instanceof GPUBuffer ? { buffer: resource } : resource,
    }));
    return this.device.createBindGroup({ layout, entries });
  }
}
