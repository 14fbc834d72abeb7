// Reads the tables of a bundle file (docs/format.md) and says where its pages are.

import { UserError } from "./source.js";

/** @typedef {import("./core.js").Core} Core */
/** @typedef {import("./source.js").Source} Source */
/** @typedef {Record<string, { dtype: string, shape: number[], data_offsets: number[] }>} Header */
/**
 * @typedef {object} Tables See docs/format.md.
 * @property {BigInt64Array} offset C + 1.
 * @property {Int32Array} level C.
 * @property {Int32Array} ownGroup C.
 * @property {Int32Array} parentGroup C.
 * @property {Float32Array} box C * 6.
 * @property {Float32Array} filter C.
 * @property {Uint8Array} antialiased C.
 * @property {Float32Array} ball G * 4.
 * @property {Float32Array} weight G.
 * @property {Int32Array} groupParent G.
 * @property {Int32Array} groupLevel G.
 * @property {Float32Array} groupError G * 2.
 * @property {BigInt64Array} pageOffset P.
 * @property {Int32Array} firstCluster P.
 * @property {Uint8Array} pageHash P * 16.
 */

const MOST_HEADER_BYTES = 2 ** 20;
const MOST_TABLE_BYTES = 2 ** 28;
/** Bytes of the first request. Headers with the settings of a build are shorter. */
const FIRST_BYTES = 2 ** 14;
const VERSIONS = ["2", "3"];
const HASH_BYTES = 16;
const HASH_PIECE_BYTES = 16384;
const PAGE_ALIGNMENT = 16;
/** Words of the ranges of a cluster, by degree. */
export const WORDS_OF_RANGES = [10, 12, 13, 15];
export const WORDS_OF_RECORD = 4;

/** Name in the file, type, rows and width of each table, in the order of the file. */
const SCHEMA = /** @type {const} */ ([
  ["offset", "clusters.offset", "I64", "C+1", 1],
  ["pageOffset", "pages.offset", "I64", "P", 1],
  ["level", "clusters.level", "I32", "C", 1],
  ["ownGroup", "clusters.own_group", "I32", "C", 1],
  ["parentGroup", "clusters.parent_group", "I32", "C", 1],
  ["box", "clusters.box", "F32", "C", 6],
  ["filter", "clusters.filter_px2", "F32", "C", 1],
  ["ball", "groups.ball", "F32", "G", 4],
  ["weight", "groups.weight", "F32", "G", 1],
  ["groupParent", "groups.parent", "I32", "G", 1],
  ["groupLevel", "groups.level", "I32", "G", 1],
  ["groupError", "groups.error", "F32", "G", 2],
  ["firstCluster", "pages.first_cluster", "I32", "P", 1],
  ["antialiased", "clusters.antialiased", "U8", "C", 1],
  ["pageHash", "pages.hash", "U8", "P", HASH_BYTES],
]);
const TYPES = { I64: BigInt64Array, I32: Int32Array, F32: Float32Array, U8: Uint8Array };

/** @param {Uint8Array} bytes */
function textOf(bytes) {
  return new TextDecoder("utf-8", { fatal: true }).decode(bytes);
}

/**
 * Return the bytes of a page.
 *
 * @param {number} gaussians
 * @param {number} clusters
 * @param {number} degree
 */
function pageBytes(gaussians, clusters, degree) {
  const words = (WORDS_OF_RECORD + 2 * degree) * gaussians + WORDS_OF_RANGES[degree] * clusters;
  return Math.ceil((4 * words) / PAGE_ALIGNMENT) * PAGE_ALIGNMENT;
}

/** An open bundle. */
export class BundleFile {
  /**
   * Read and check the tables.
   *
   * @param {Source} source
   * @param {() => Promise<Core>} newCore Makes a core, which a failed check ends.
   */
  static async open(source, newCore) {
    const { head, header, degree, version } = await readHeader(source);
    const file = new BundleFile(source, degree, head.length);
    await file.readTables(head, header, version, newCore);
    return file;
  }

  /**
   * @param {Source} source
   * @param {number} degree Of the spherical harmonics.
   * @param {number} dataStart First byte of the pages in the file.
   */
  constructor(source, degree, dataStart) {
    this.source = source;
    this.degree = degree;
    this.dataStart = dataStart;
    /** @type {Tables} */
    this.tables = null;
    /** Gaussians before each cluster, C + 1. @type {Float64Array} */
    this.rows = null;
    /** The coarsest page. @type {Uint8Array} */
    this.root = null;
    /** First byte of each page, from `dataStart`, and the end, P + 1. @type {Float64Array} */
    this.pageStart = null;
  }

  get numPages() {
    return this.tables.firstCluster.length;
  }

  /** Bytes of the largest page. */
  get mostPageBytes() {
    let most = 0;
    for (let page = 0; page < this.numPages; page += 1) most = Math.max(most, this.bytesOf(page));
    return most;
  }

  /** @param {number} page */
  bytesOf(page) {
    return this.pageStart[page + 1] - this.pageStart[page];
  }

  /** @param {number} page */
  endCluster(page) {
    const { firstCluster, level } = this.tables;
    return page + 1 < this.numPages ? firstCluster[page + 1] : level.length;
  }

  /** @param {number} cluster */
  pageOf(cluster) {
    const group = this.tables.parentGroup[cluster];
    return group < 0 ? this.numPages - 1 : group;
  }

  /**
   * Return the page of which the clusters of a group's page were made; -1 for the last page.
   *
   * @param {number} page
   */
  pageAbove(page) {
    const { groupParent } = this.tables;
    if (page === groupParent.length) return -1;
    return groupParent[page] < 0 ? groupParent.length : groupParent[page];
  }

  /** @param {string} text */
  problem(text) {
    return new UserError(`${this.source.name}: ${text}`);
  }

  /**
   * @param {Uint8Array} head The bytes before the pages.
   * @param {Header} header What they say.
   * @param {string} version
   * @param {() => Promise<Core>} newCore
   */
  async readTables(head, header, version, newCore) {
    const { source, dataStart } = this;
    const [pagesBytes] = header.pages?.shape ?? [];
    const places = placesOf(header, pagesBytes);
    if (places === null) {
      throw this.problem("expected the tables of a quantised bundle in its header, got others");
    }
    const start = dataStart + pagesBytes;
    const end = dataStart + places.end;
    if (end !== source.size) {
      throw this.problem(`expected a file of ${end} bytes, got ${source.size}; write it again`);
    }
    if (end - start > MOST_TABLE_BYTES) {
      throw this.problem(`expected tables of at most ${MOST_TABLE_BYTES} bytes`);
    }
    const bytes = await source.read(start, end);
    const core = await newCore();
    if (!isHashed(core, version, head, bytes)) {
      throw this.problem("its header or its tables do not match their hash; write the file again");
    }
    const tables = /** @type {Tables} */ ({});
    for (const [key, first, last, Type] of places.tables) {
      tables[key] = new Type(bytes.slice(first - pagesBytes, last - pagesBytes).buffer);
    }
    this.tables = tables;
    try {
      core.checkTables(tables);
    } catch {
      throw this.problem("its tables contradict each other; write the file again");
    }
    this.rows = Float64Array.from(tables.offset, Number);
    this.checkPages(pagesBytes);
  }

  /**
   * Check that pages follow one another as their sizes say.
   *
   * @param {number} pagesBytes
   */
  checkPages(pagesBytes) {
    const { tables, rows, degree, numPages } = this;
    const numClusters = tables.level.length;
    const expectedPages = numClusters > 0 ? tables.weight.length + 1 : 0;
    let isValid = numPages === expectedPages && numPages > 0;
    this.pageStart = new Float64Array(numPages + 1);
    let cluster = 0;
    for (let page = 0; isValid && page < numPages; page += 1) {
      const first = cluster;
      while (cluster < numClusters && this.pageOf(cluster) === page) cluster += 1;
      isValid = tables.firstCluster[page] === first;
      isValid &&= Number(tables.pageOffset[page]) === this.pageStart[page];
      const bytes = pageBytes(rows[cluster] - rows[first], cluster - first, degree);
      this.pageStart[page + 1] = this.pageStart[page] + bytes;
    }
    if (!isValid || cluster !== numClusters || this.pageStart[numPages] !== pagesBytes) {
      throw this.problem("its pages are not where its tables say; write the file again");
    }
  }

  /**
   * Read neighbouring pages. Returns the bytes of each.
   *
   * @param {number} first
   * @param {number} end
   */
  async readPages(first, end) {
    const { dataStart, pageStart, source } = this;
    const bytes = await source.read(dataStart + pageStart[first], dataStart + pageStart[end]);
    const pages = [];
    for (let page = first; page < end; page += 1) {
      const begin = pageStart[page] - pageStart[first];
      pages.push(bytes.subarray(begin, begin + this.bytesOf(page)));
    }
    return pages;
  }

  /**
   * Read the coarsest page.
   *
   * @param {Core} core
   */
  async readRoot(core) {
    const page = this.numPages - 1;
    const [bytes] = await this.readPages(page, page + 1);
    this.verify(core, page, bytes);
    this.root = bytes;
  }

  /**
   * Throw UserError unless the bytes of a page match its hash and are valid.
   *
   * @param {Core} core
   * @param {number} page
   * @param {Uint8Array} bytes
   */
  verify(core, page, bytes) {
    const expected = this.tables.pageHash.subarray(HASH_BYTES * page, HASH_BYTES * (page + 1));
    if (!core.hash(bytes).every((byte, k) => byte === expected[k])) {
      throw this.problem("a page does not match its hash: the file has changed; reload the page");
    }
    const { offset, firstCluster } = this.tables;
    const rows = offset.subarray(firstCluster[page], this.endCluster(page) + 1);
    if (!core.isValidPage(rows, bytes, this.degree)) {
      throw this.problem("a page has invalid ranges; write the file again");
    }
  }
}

/** @param {Source} source */
async function readHeader(source) {
  let bytes = await source.read(0, FIRST_BYTES);
  const refuse = (/** @type {string} */ expected) =>
    new UserError(`${source.name}: expected ${expected}; write it with v3dg`);
  if (bytes.length < 8) throw refuse("a v3dg bundle");
  const length = new DataView(bytes.buffer, bytes.byteOffset).getBigUint64(0, true);
  if (length > MOST_HEADER_BYTES) throw refuse("a v3dg bundle");
  const dataStart = 8 + Number(length);
  if (bytes.length < dataStart) bytes = await source.read(0, dataStart);
  const head = bytes.subarray(0, dataStart);
  let header;
  try {
    header = JSON.parse(textOf(head.subarray(8)));
  } catch {
    throw refuse("a v3dg bundle");
  }
  const { __metadata__: metadata } = header ?? {};
  const { format, version, codec, sh_degree: degree } = metadata ?? {};
  if (format !== "v3dg") throw refuse("a v3dg bundle");
  if (codec !== "quantized") throw refuse("a bundle with the codec quantized");
  if (!VERSIONS.includes(version)) throw refuse(`version ${VERSIONS.join(" or ")} of the format`);
  if (!["0", "1", "2", "3"].includes(degree)) throw refuse("spherical harmonics of degree 0 to 3");
  return { head, header, version, degree: Number(degree) };
}

/** @param {unknown} number */
function isCount(number) {
  return Number.isSafeInteger(number) && /** @type {number} */ (number) >= 0;
}

/**
 * Return the numbers of clusters, groups and pages; null if the header has none.
 *
 * @param {Header} header
 */
function countsOf(header) {
  const names = ["clusters.level", "groups.weight", "pages.offset"];
  const [clusters, groups, pages] = names.map((name) => header[name]?.shape?.[0]);
  if (![clusters, groups, pages].every(isCount)) return null;
  return { C: clusters, "C+1": clusters + 1, G: groups, P: pages };
}

/**
 * Return where each table must be, from the start of the pages; null if the header differs.
 *
 * @param {Header} header
 * @param {number} pagesBytes
 */
function placesOf(header, pagesBytes) {
  const counts = countsOf(header);
  if (counts === null || !isCount(pagesBytes)) return null;
  let end = pagesBytes;
  /** @type {[string, number, number, typeof TYPES[keyof typeof TYPES]][]} */
  const tables = [];
  for (const [key, name, dtype, rows, width] of SCHEMA) {
    const first = end;
    end += counts[rows] * width * TYPES[dtype].BYTES_PER_ELEMENT;
    const entry = header[name];
    if (entry?.dtype !== dtype) return null;
    if (entry.data_offsets?.[0] !== first || entry.data_offsets[1] !== end) return null;
    tables.push([key, first, end, TYPES[dtype]]);
  }
  return { tables, end: end + HASH_BYTES };
}

/**
 * Whether the header and the tables match the hash at their end.
 *
 * @param {Core} core
 * @param {string} version
 * @param {Uint8Array} head
 * @param {Uint8Array} tail The tables, and the hash.
 */
function isHashed(core, version, head, tail) {
  const tables = tail.subarray(0, tail.length - HASH_BYTES);
  const message = new Uint8Array(head.length + tables.length);
  message.set(head);
  message.set(tables, head.length);
  let digests = message;
  if (version === "3") {
    const numPieces = Math.ceil(message.length / HASH_PIECE_BYTES);
    digests = new Uint8Array(HASH_BYTES * numPieces);
    for (let k = 0; k < numPieces; k += 1) {
      const piece = message.subarray(HASH_PIECE_BYTES * k, HASH_PIECE_BYTES * (k + 1));
      digests.set(core.hash(piece), HASH_BYTES * k);
    }
  }
  const expected = tail.subarray(tail.length - HASH_BYTES);
  return core.hash(digests).every((byte, k) => byte === expected[k]);
}
