// Computes the layout of a cut for project.wgsl: where the codes of each cluster are in
// the pool.

import { WORDS_OF_RANGES, WORDS_OF_RECORD } from "./bundle_file.js";
import { GAUSSIANS_OF_WORKGROUP, WORDS_OF_PAIR } from "./renderer.js";

/** @typedef {import("./bundle_file.js").BundleFile} BundleFile */
/** @typedef {import("./placement.js").Instances} Instances */
/** @typedef {import("./renderer.js").Cut} Cut */
/**
 * The clusters of a cut.
 *
 * @typedef {object} Selection
 * @property {Int32Array} instance
 * @property {Int32Array} cluster
 * @property {Float32Array} weight The weight of each cluster, or null if all weights
 *   are 1.
 */

const ANTIALIASED = 1;
const LIMITED = 2;
const DEGREE_SHIFT = 4;
/** The filter of level 0 in a cut with a fade, px² (csrc/residency/cluster_table.h). */
const FADE_FILTER = 0.05;

/**
 * Return the filter of a cluster, and whether it is antialiased.
 *
 * @param {BundleFile} bundle
 * @param {number} cluster
 * @param {boolean} fades
 */
function lookOf({ tables, degree }, cluster, fades) {
  const filter = tables.filter[cluster];
  if (fades && tables.ownGroup[cluster] < 0 && filter === 0) {
    return { filter: FADE_FILTER, look: ANTIALIASED | LIMITED | (degree << DEGREE_SHIFT) };
  }
  const flags = tables.antialiased[cluster] === 0 ? 0 : ANTIALIASED;
  return { filter, look: flags | (degree << DEGREE_SHIFT) };
}

/**
 * Return a selection in the layout that project.wgsl reads.
 *
 * @param {Selection} selection The cut. All of its pages must be in the pool.
 * @param {BundleFile[]} bundles
 * @param {Float64Array[]} places For each bundle, the first byte of each page in the
 *   pool.
 * @param {Instances} instances
 * @returns {Cut}
 */
export function layOut(selection, bundles, places, instances) {
  const numPairs = selection.instance.length;
  const pairs = new Uint32Array(WORDS_OF_PAIR * numPairs);
  const floats = new Float32Array(pairs.buffer);
  /** @type {number[]} */
  const firstPairs = [];
  /** @type {number[]} */
  const drawn = [];
  let count = 0;
  for (let s = 0; s < numPairs; s += 1) {
    const instance = selection.instance[s];
    const cluster = selection.cluster[s];
    const bundle = bundles[instances.bundle[instance]];
    const { rows, degree, tables } = bundle;
    if (drawn.at(-1) !== instance) drawn.push(instance);
    const page = bundle.pageOf(cluster);
    const firstCluster = tables.firstCluster[page];
    const place = places[instances.bundle[instance]][page] / 4;
    const row = rows[cluster] - rows[firstCluster];
    const pageRows = rows[bundle.endCluster(page)] - rows[firstCluster];
    const { filter, look } = lookOf(bundle, cluster, selection.weight !== null);
    const at = WORDS_OF_PAIR * s;
    const end = count + rows[cluster + 1] - rows[cluster];
    while (firstPairs.length * GAUSSIANS_OF_WORKGROUP < end) firstPairs.push(s);
    count = end;
    pairs[at] = drawn.length - 1;
    pairs[at + 1] = end;
    pairs[at + 2] = place + WORDS_OF_RECORD * row;
    pairs[at + 3] = place + WORDS_OF_RECORD * pageRows + 2 * degree * row;
    pairs[at + 4] = place + (WORDS_OF_RECORD + 2 * degree) * pageRows;
    pairs[at + 4] += WORDS_OF_RANGES[degree] * (cluster - firstCluster);
    floats[at + 5] = filter;
    pairs[at + 6] = look;
    const opacity = instances.factors === null ? 1 : instances.factors[4 * instance + 3];
    floats[at + 7] = opacity * (selection.weight === null ? 1 : selection.weight[s]);
  }
  const firstOfWorkgroup = Uint32Array.from(firstPairs);
  return { count, pairs, firstPairs: firstOfWorkgroup, instances: Int32Array.from(drawn) };
}
