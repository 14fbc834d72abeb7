// The buffers of a frame. They grow with the cut and with the pairs of gaussians and
// tiles, whose number only the device knows.

export const GAUSSIANS_OF_WORKGROUP = 256;
export const PAIRS_OF_WORKGROUP = 1024;
export const KEYS_OF_TILE = 1024;
export const DIGITS = 256;
export const DEPTH_PASSES = 3;
export const TILE_PASSES = 2;
/** Tiles are sorted by 16 bits, of which one number marks pairs that are not drawn. */
export const MOST_TILES = 2 ** 16 - 1;
const MOST_WORKGROUPS = 2 ** 16 - 1;
const BITS_OF_DIGIT = 8;
const BYTES_OF_RECORD = 32;
export const BYTES_OF_SIZES = 16;
const BYTES_OF_RANGE = 8;
const BYTES_OF_CAMERA = 64;
/** Distance between the uniforms of sorting passes: the alignment that devices need. */
const UNIFORM_STRIDE = 256;
const BYTES_OF_PASS = 16;
const LEAST_CAPACITY = 1 << 14;
const PAIRS_OF_GAUSSIAN = 2;

/** The names of keys and values on both sides of a sort. */
export const DEPTH_SIDES = [
  ["keys", "values"],
  ["otherKeys", "otherValues"],
];
export const TILE_SIDES = [
  ["tiles", "gaussians"],
  ["otherTiles", "otherGaussians"],
];

export class FrameBuffers {
  /**
   * @param {GPUDevice} device
   * @param {number} mostBytes Size of the largest buffer that shaders can use.
   */
  constructor(device, mostBytes) {
    this.device = device;
    this.mostBytes = mostBytes;
    const { STORAGE, COPY_DST, COPY_SRC, UNIFORM } = GPUBufferUsage;
    /** @type {Map<string, GPUBuffer>} */
    this.buffers = new Map();
    /** Largest number of gaussians that the buffers have room for. */
    this.capacity = 0;
    /** Largest number of pairs of gaussians and tiles. */
    this.pairCapacity = 0;
    this.replace("camera", BYTES_OF_CAMERA, UNIFORM | COPY_DST);
    this.replace("sizes", BYTES_OF_SIZES, STORAGE | COPY_DST);
    this.replace("pairSizes", BYTES_OF_SIZES, STORAGE | COPY_DST | COPY_SRC);
    this.replace("ranges", BYTES_OF_RANGE * MOST_TILES, STORAGE | COPY_DST);
    this.replace("depthPasses", DEPTH_PASSES * UNIFORM_STRIDE, UNIFORM | COPY_DST);
    this.replace("tilePasses", TILE_PASSES * UNIFORM_STRIDE, UNIFORM | COPY_DST);
    this.replace("totals", 4 * DIGITS, STORAGE);
    this.reserve(LEAST_CAPACITY);
  }

  /** Bytes of all buffers. */
  get bytes() {
    let bytes = 0;
    for (const buffer of this.buffers.values()) bytes += buffer.size;
    return bytes;
  }

  /** Largest number of gaussians of a cut. */
  get mostGaussians() {
    const byMemory = Math.floor(this.mostBytes / BYTES_OF_RECORD);
    return Math.min(byMemory, MOST_WORKGROUPS * GAUSSIANS_OF_WORKGROUP);
  }

  /** Largest number of pairs that any frame can have. */
  get mostPairs() {
    return Math.min(Math.floor(this.mostBytes / 4), MOST_WORKGROUPS * PAIRS_OF_WORKGROUP);
  }

  /** @param {string[]} names */
  get(...names) {
    return names.map((name) => this.buffers.get(name));
  }

  /**
   * Enlarge the buffers, if necessary, for a number of gaussians.
   *
   * @param {number} count
   */
  reserve(count) {
    if (count <= this.capacity) return;
    const wanted = Math.max(count, LEAST_CAPACITY, Math.ceil(1.25 * this.capacity));
    this.capacity = Math.min(wanted, this.mostGaussians);
    const { STORAGE } = GPUBufferUsage;
    this.replace("records", BYTES_OF_RECORD * this.capacity, STORAGE);
    for (const name of DEPTH_SIDES.flat()) this.replace(name, 4 * this.capacity, STORAGE);
    this.replace("blocks", 4 * Math.ceil(this.capacity / GAUSSIANS_OF_WORKGROUP), STORAGE);
    this.reservePairs(PAIRS_OF_GAUSSIAN * this.capacity);
  }

  /**
   * Enlarge the buffers, if necessary, for a number of pairs. Return whether they have
   * grown.
   *
   * @param {number} count
   */
  reservePairs(count) {
    if (count <= this.pairCapacity || this.pairCapacity === this.mostPairs) return false;
    this.pairCapacity = Math.min(Math.ceil(1.25 * count), this.mostPairs);
    const { STORAGE } = GPUBufferUsage;
    for (const name of TILE_SIDES.flat()) this.replace(name, 4 * this.pairCapacity, STORAGE);
    const numTiles = Math.ceil(Math.max(this.pairCapacity, this.capacity) / KEYS_OF_TILE);
    this.replace("counts", 4 * DIGITS * numTiles, STORAGE);
    this.writePasses("tilePasses", TILE_PASSES, this.pairCapacity, 0);
    return true;
  }

  /**
   * Write the uniforms of the passes of a sort by depth.
   *
   * @param {number} count Gaussians.
   */
  setCount(count) {
    this.writePasses("depthPasses", DEPTH_PASSES, count, BITS_OF_DIGIT * DEPTH_PASSES);
  }

  /**
   * @param {string} name
   * @param {number} numPasses
   * @param {number} count Largest number of keys.
   * @param {number} bits As in sort.wgsl.
   */
  writePasses(name, numPasses, count, bits) {
    const words = new Uint32Array((numPasses * UNIFORM_STRIDE) / 4);
    const numTiles = Math.ceil(count / KEYS_OF_TILE);
    for (let pass = 0; pass < numPasses; pass += 1) {
      const isFirst = bits > 0 && pass === 0 ? 1 : 0;
      words.set([BITS_OF_DIGIT * pass, numTiles, bits, isFirst], (pass * UNIFORM_STRIDE) / 4);
    }
    this.device.queue.writeBuffer(this.buffers.get(name), 0, words);
  }

  /**
   * Return the uniforms of one pass.
   *
   * @param {string} name
   * @param {number} pass
   */
  passOf(name, pass) {
    const buffer = this.buffers.get(name);
    return { buffer, offset: pass * UNIFORM_STRIDE, size: BYTES_OF_PASS };
  }

  /**
   * @param {string} name
   * @param {number} size
   * @param {number} usage
   */
  replace(name, size, usage) {
    this.buffers.get(name)?.destroy();
    this.buffers.set(name, this.device.createBuffer({ size, usage }));
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
      const { STORAGE, COPY_DST } = GPUBufferUsage;
      this.replace(name, 4 * Math.ceil(bytes / 3), STORAGE | COPY_DST);
    }
    this.device.queue.writeBuffer(this.buffers.get(name), 0, array);
  }
}
