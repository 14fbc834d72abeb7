// The interface of core.cpp for JavaScript. Tables and views are copied to the module's
// memory, and cuts and rows are returned as arrays. It works in web pages, in workers
// and in node.

const WORDS_OF_BUNDLE = 14;
const BYTES_OF_VIEW = 8 * 29 + 4 * 8;
const BYTES_OF_CUT = 32;
const NO_POINTER = 0;

// The functions that the module may call. It has no files, so all of them fail, except
// for those that end the module.
const HOST = {
  fd_write: () => 8,
  fd_close: () => 8,
  fd_seek: () => 8,
  fd_fdstat_get: () => 8,
  proc_exit: (code) => {
    throw new Error(`v3dg: the module ended with code ${code}`);
  },
};

/** A loaded module: its memory, and the functions of core.cpp. */
export class Core {
  /**
   * Load the module.
   *
   * @param {BufferSource | WebAssembly.Module} code The module that csrc/wasm/build.py
   *   has made, as bytes or compiled.
   */
  static async load(code) {
    const made = await WebAssembly.instantiate(code, { wasi_snapshot_preview1: HOST });
    const { exports } = made.instance ?? made;
    const { _initialize: initialize } = exports;
    initialize?.();
    return new Core(exports);
  }

  constructor(exports) {
    this.calls = exports;
    this.argument = this.allocate(BYTES_OF_VIEW);
    this.result = this.allocate(BYTES_OF_CUT);
  }

  allocate(bytes) {
    const place = this.calls.v3dg_allocate(bytes) >>> 0;
    if (place === NO_POINTER) throw new Error(`v3dg: no memory for ${bytes} bytes`);
    return place;
  }

  /** Copy an array of numbers to the module. null becomes the null pointer. */
  copy(array) {
    if (array === null || array === undefined) return NO_POINTER;
    const place = this.allocate(Math.max(array.byteLength, 8));
    this.write(place, array);
    return place;
  }

  write(place, array) {
    const bytes = new Uint8Array(array.buffer, array.byteOffset, array.byteLength);
    new Uint8Array(this.calls.memory.buffer, place, array.byteLength).set(bytes);
  }

  /** Return a copy of `count` numbers at an address in the module. */
  read(Type, place, count) {
    return new Type(this.calls.memory.buffer, place, count).slice();
  }

  /** A view of the module's memory. It is valid until the module allocates memory. */
  view() {
    return new DataView(this.calls.memory.buffer);
  }

  /** Return the hash of a page, which has 16 bytes. */
  hash(bytes) {
    const message = this.copy(bytes);
    this.calls.v3dg_hash(message, bytes.byteLength, this.result);
    const hash = this.read(Uint8Array, this.result, 16);
    this.calls.v3dg_free(message);
    return hash;
  }

  /**
   * Check the tables of a file. If they are invalid, the module ends with a trap, and
   * must be loaded again.
   *
   * @param {object} tables The tables, as in bundle_file.js.
   */
  checkTables(tables) {
    const places = [
      tables.offset,
      tables.level,
      tables.ownGroup,
      tables.parentGroup,
      tables.box,
      tables.filter,
      tables.antialiased,
      tables.ball,
      tables.weight,
      tables.groupParent,
      tables.groupLevel,
      tables.groupError,
    ].map((array) => this.copy(array));
    const argument = this.copy(
      Uint32Array.from([tables.weight.length, tables.ownGroup.length, ...places]),
    );
    this.calls.v3dg_check_tables(argument);
    [...places, argument].forEach((place) => this.calls.v3dg_free(place));
  }

  /**
   * Return whether all gaussians of a coded page are finite.
   *
   * @param {BigInt64Array} offset The first row of each cluster, then the end.
   * @param {Uint8Array} bytes The bytes of the page.
   * @param {number} degree The degree of the spherical harmonics.
   */
  isValidPage(offset, bytes, degree) {
    const relative = BigInt64Array.from(offset, (row) => row - offset[0]);
    const places = [this.copy(relative), this.copy(bytes)];
    const clusters = offset.length - 1;
    const valid = this.calls.v3dg_check_page(places[0], clusters, places[1], degree);
    places.forEach((place) => this.calls.v3dg_free(place));
    return valid === clusters;
  }

  /**
   * Decode a coded page to rows.
   *
   * @param {BigInt64Array} offset The first row of each cluster, then the end.
   * @param {Uint8Array} bytes The bytes of the page.
   * @param {number} degree The degree of the spherical harmonics.
   */
  decodePage(offset, bytes, degree) {
    const count = Number(offset[offset.length - 1] - offset[0]);
    const relative = BigInt64Array.from(offset, (row) => row - offset[0]);
    const widths = { means: 3, quats: 4, scales: 3, opacities: 1, sh: 3 * (degree + 1) ** 2 };
    const places = Object.values(widths).map((width) => this.allocate(4 * width * count + 8));
    const given = [this.copy(relative), this.copy(bytes)];
    const clusters = offset.length - 1;
    const done = this.calls.v3dg_decode_page(given[0], clusters, given[1], degree, ...places);
    const rows = {};
    Object.entries(widths).forEach(([name, width], k) => {
      rows[name] = this.read(Float32Array, places[k], width * count);
    });
    [...places, ...given].forEach((place) => this.calls.v3dg_free(place));
    if (done < clusters) throw new Error(`v3dg: cluster ${done} of a page has invalid ranges`);
    return rows;
  }
}

/** The tables of a bundle, in the memory of the module. */
export class Bundle {
  /**
   * @param {Core} core
   * @param {object} tables `ball` (G * 4), `weight` (G), `level` (G), `ownGroup` (C),
   *   `parentGroup` (C), `box` (C * 6), `offset` (C + 1, BigInt64Array), `filter` (C),
   *   `antialiased` (C, Uint8Array); with absent pages also `shift` (G + 1,
   *   BigInt64Array), `begins` (G + 1, Int32Array) or null, `needs` (G + 1, Uint32Array)
   */
  constructor(core, tables) {
    this.core = core;
    this.numGroups = tables.weight.length;
    const places = [
      tables.ball,
      tables.weight,
      tables.level,
      tables.ownGroup,
      tables.parentGroup,
      tables.box,
      tables.offset,
      tables.filter,
      tables.antialiased,
      tables.shift,
      tables.begins,
      tables.needs,
    ].map((array) => core.copy(array));
    this.places = places;
    const argument = core.allocate(4 * WORDS_OF_BUNDLE);
    const words = [this.numGroups, tables.ownGroup.length, ...places];
    core.write(argument, Uint32Array.from(words));
    this.pointer = core.calls.v3dg_make_bundle(argument) >>> 0;
    core.calls.v3dg_free(argument);
  }

  /** Replace the page table. The arrays must have the same lengths as before. */
  setPages(shift, begins) {
    this.core.write(this.places[9], shift);
    if (begins) this.core.write(this.places[10], begins);
  }

  /** Return the priorities of the pages that cuts have needed since the last call. */
  takeNeeds() {
    const needs = this.core.read(Float32Array, this.places[11], this.numGroups + 1);
    this.core.write(this.places[11], new Uint32Array(this.numGroups + 1));
    return needs;
  }

  free() {
    this.core.calls.v3dg_free_bundle(this.pointer);
    this.places.forEach((place) => this.core.calls.v3dg_free(place));
  }
}

/** Bundles and their instances. */
export class Scene {
  /**
   * Store the arguments.
   *
   * @param {Bundle[]} bundles The bundles, which must outlive the scene.
   */
  constructor(core, bundles) {
    this.core = core;
    this.places = [];
    const pointers = core.copy(Uint32Array.from(bundles, (bundle) => bundle.pointer));
    this.pointer = core.calls.v3dg_make_scene(pointers, bundles.length) >>> 0;
    core.calls.v3dg_free(pointers);
  }

  /**
   * @param {object} instances `bundle` (I, Int32Array), `positions` (I * 3) `quaternions`
   *   (I * 4, w x y z) and `scales` (I) as Float64Array, `importance` (I) and `factors`
   *   (I * 4: red, green, blue, opacity; or null) as Float32Array
   */
  setInstances(instances) {
    this.places.forEach((place) => this.core.calls.v3dg_free(place));
    this.places = [
      instances.bundle,
      instances.positions,
      instances.quaternions,
      instances.scales,
      instances.importance,
      instances.factors,
    ].map((array) => this.core.copy(array));
    this.core.write(
      this.core.argument,
      Uint32Array.from([instances.bundle.length, ...this.places]),
    );
    this.core.calls.v3dg_set_instances(this.pointer, this.core.argument);
  }

  /**
   * Select the cut of a view.
   * @param {object} view `viewmat` (16) and `k` (9), row major; `near`, `width`,
   *   `height`, `tolerance`; optional `budget`, `fade`, `minLevel`, `culls`, `isPaper`,
   *   `inSteps`, `framesAtRest`, `frame`
   */
  select(view) {
    const { core } = this;
    const numbers = Float64Array.from([
      ...view.viewmat,
      ...view.k,
      view.near,
      view.tolerance,
      view.budget ?? -1,
      view.fade ?? 1,
    ]);
    core.write(core.argument, numbers);
    const flags = [
      view.width,
      view.height,
      view.minLevel ?? 0,
      (view.culls ?? true) ? 1 : 0,
      view.isPaper ? 1 : 0,
      view.inSteps ? 1 : 0,
      view.framesAtRest ?? 0,
      view.frame ?? 0,
    ];
    core.write(core.argument + numbers.byteLength, Int32Array.from(flags));
    core.calls.v3dg_select(this.pointer, core.argument, core.result);
    const out = core.view();
    const word = (index) => out.getUint32(core.result + 4 * index, true);
    const count = word(4);
    const weight = word(7);
    return {
      numGaussians: out.getFloat64(core.result, true),
      tolerance: out.getFloat32(core.result + 8, true),
      fitsBudget: word(3) !== 0,
      instance: core.read(Int32Array, word(5), count),
      cluster: core.read(Int32Array, word(6), count),
      weight: weight === NO_POINTER ? null : core.read(Float32Array, weight, count),
    };
  }

  free() {
    this.core.calls.v3dg_free_scene(this.pointer);
    this.places.forEach((place) => this.core.calls.v3dg_free(place));
  }
}
