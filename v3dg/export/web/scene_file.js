// Reads scene files (docs/scene.md) as `v3dg export` and `v3dg.write_scene` write them:
// bundles, instances with position, quaternion and scale, and pinhole cameras.

import { UserError, nameOf } from "./source.js";

/** @typedef {import("./placement.js").Instances} Instances */
/** @typedef {import("./placement.js").Pinhole} Pinhole */
/** @typedef {Pinhole & { name: string }} NamedCamera */
/** @typedef {"x" | "y" | "z" | "-x" | "-y" | "-z"} Axis */
/**
 * @typedef {object} SceneFile
 * @property {string[]} urls Of the bundles.
 * @property {Instances} instances
 * @property {NamedCamera[]} cameras
 * @property {Axis} up The axis that points up; null if unknown.
 */

const AXES = new Set(["x", "y", "z", "-x", "-y", "-z"]);
const DEFAULT_NEAR = 0.01;
const MOST_INSTANCES = 10_000_000;
const IDENTITY = [1, 0, 0, 0];
const WHITE = [1, 1, 1];

/** Refuses wrong values with the place in the file. */
class Reader {
  /** @param {string} name Of the file. */
  constructor(name) {
    this.name = name;
  }

  /**
   * @param {string} place
   * @param {string} expected
   * @returns {never}
   */
  refuse(place, expected) {
    throw new UserError(`${this.name}: ${place}: expected ${expected}`);
  }

  /**
   * @param {unknown} value
   * @param {string} place
   * @param {number} count
   */
  numbers(value, place, count) {
    const flat = Array.isArray(value) ? value.flat() : [];
    if (flat.length !== count || !flat.every(Number.isFinite)) {
      this.refuse(place, `${count} numbers`);
    }
    return /** @type {number[]} */ (flat);
  }

  /**
   * @param {unknown} value
   * @param {string} place
   */
  positive(value, place) {
    if (!Number.isFinite(value) || !(/** @type {number} */ (value > 0))) {
      this.refuse(place, "a positive number");
    }
    return /** @type {number} */ (value);
  }

  /**
   * @param {unknown} value
   * @param {string} place
   * @returns {unknown[]}
   */
  list(value, place) {
    return Array.isArray(value) ? value : this.refuse(place, "a list");
  }

  /**
   * @param {unknown} value
   * @param {string} place
   * @returns {Record<string, unknown>}
   */
  object(value, place) {
    if (typeof value !== "object" || value === null || Array.isArray(value)) {
      this.refuse(place, "an object");
    }
    return /** @type {Record<string, unknown>} */ (value);
  }
}

/**
 * Return memory for instances, each at the origin.
 *
 * @param {number} count
 * @returns {Instances}
 */
function instancesAtOrigin(count) {
  return {
    bundle: new Int32Array(count),
    positions: new Float64Array(3 * count),
    quaternions: new Float64Array(4 * count),
    scales: new Float64Array(count).fill(1),
    importance: new Float32Array(count).fill(1),
    factors: new Float32Array(4 * count).fill(1),
  };
}

/**
 * Return a scene with one instance of a bundle.
 *
 * @param {string} url
 * @returns {SceneFile}
 */
function sceneOfBundle(url) {
  const instances = instancesAtOrigin(1);
  instances.quaternions.set(IDENTITY);
  return { urls: [url], instances, cameras: [], up: null };
}

/**
 * @param {Reader} reader
 * @param {unknown[]} list
 * @param {string[]} names Of the bundles.
 */
function readInstances(reader, list, names) {
  if (list.length > MOST_INSTANCES) reader.refuse("instances", `at most ${MOST_INSTANCES}`);
  const all = instancesAtOrigin(list.length);
  list.forEach((value, k) => {
    const place = `instances[${k}]`;
    const row = reader.object(value, place);
    const bundle = names.indexOf(/** @type {string} */ (row.bundle));
    if (bundle < 0) reader.refuse(`${place}.bundle`, "a name in bundles");
    all.bundle[k] = bundle;
    all.positions.set(reader.numbers(row.position, `${place}.position`, 3), 3 * k);
    const quaternion = reader.numbers(row.quaternion ?? IDENTITY, `${place}.quaternion`, 4);
    if (!quaternion.some(Boolean)) reader.refuse(`${place}.quaternion`, "a nonzero quaternion");
    all.quaternions.set(quaternion, 4 * k);
    all.scales[k] = reader.positive(row.scale ?? 1, `${place}.scale`);
    all.importance[k] = reader.positive(row.importance ?? 1, `${place}.importance`);
    all.factors.set(reader.numbers(row.tint ?? WHITE, `${place}.tint`, 3), 4 * k);
    all.factors.set(reader.numbers([row.opacity ?? 1], `${place}.opacity`, 1), 4 * k + 3);
  });
  return all;
}

/**
 * @param {Reader} reader
 * @param {unknown} value
 * @param {number} index
 * @returns {NamedCamera}
 */
function readCamera(reader, value, index) {
  const place = `cameras[${index}]`;
  const row = reader.object(value, place);
  return {
    name: String(row.name),
    width: reader.positive(row.width, `${place}.width`),
    height: reader.positive(row.height, `${place}.height`),
    near: reader.positive(row.near ?? DEFAULT_NEAR, `${place}.near`),
    viewmat: reader.numbers(row.viewmat, `${place}.viewmat`, 16),
    k: reader.numbers(row.K, `${place}.K`, 9),
  };
}

/** @param {string} url */
async function loadJson(url) {
  const name = nameOf(url);
  let response;
  try {
    response = await fetch(url);
  } catch {
    throw new UserError(`${name}: the server does not answer; reload the page`);
  }
  if (!response.ok) throw new UserError(`${name}: the server answered ${response.status}`);
  try {
    return await response.json();
  } catch {
    throw new UserError(`${name}: expected a scene in JSON`);
  }
}

/**
 * Read a scene, or take a bundle as a scene of one instance.
 *
 * @param {string} url Absolute; a bundle's name ends in .v3dg.
 * @returns {Promise<SceneFile>}
 */
export async function readScene(url) {
  if (nameOf(url).endsWith(".v3dg")) return sceneOfBundle(url);
  const reader = new Reader(nameOf(url));
  const root = reader.object(await loadJson(url), "file");
  if (root.format !== "v3dg-scene" || root.version !== 1) {
    reader.refuse("format", "v3dg-scene of version 1");
  }
  if (root.scenes !== undefined) {
    reader.refuse("scenes", "none; write the scene with v3dg export");
  }
  const bundles = reader.object(root.bundles, "bundles");
  const urls = Object.entries(bundles).map(([name, path]) => {
    const { href, origin } = new URL(String(path), url);
    if (origin !== new URL(url).origin) reader.refuse(`bundles.${name}`, "a file of this server");
    return href;
  });
  const list = reader.list(root.instances, "instances");
  const instances = readInstances(reader, list, Object.keys(bundles));
  const cameras = reader.list(root.cameras ?? [], "cameras");
  const up = /** @type {Axis} */ (root.up ?? null);
  if (up !== null && !AXES.has(up)) reader.refuse("up", "an axis");
  const read = cameras.map((camera, k) => readCamera(reader, camera, k));
  return { urls, instances, cameras: read, up };
}
