// Which pages of all bundles are resident, in memory of a fixed size: the coarsest page
// of each bundle, then slots of equal size. A page becomes resident after the page above
// it, and leaves before that one, so the pool is closed towards the root. The page that
// was not needed for longest leaves first.

import { UserError } from "./source.js";

/** @typedef {import("./bundle_file.js").BundleFile} BundleFile */
/** @typedef {{ bundle: number, page: number, priority: number }} Wanted */

const ABSENT_PAGE = -(2n ** 63n);
const NEVER_BEGINS = 2 ** 31 - 1;
/** A page fades in during this many frames (csrc/residency/page_table.h). */
export const ARRIVAL_FRAMES = 8;
/** Pages with at least this priority are requested (csrc/select/page_need.h). */
const LEAST_PRIORITY = 0.5;
/** The priority of a page is this many times that of each page below it. */
const ABOVE = 2;
const MOST_PRIORITY = 2 ** 30;
const NO_SLOT = -1;

/** The pages of one bundle. */
class Pages {
  /** @param {BundleFile} file */
  constructor(file) {
    const { numPages } = file;
    this.file = file;
    /** For each page, see PageTable in csrc/residency/page_table.h. */
    this.shift = new BigInt64Array(numPages).fill(ABSENT_PAGE);
    this.begins = new Int32Array(numPages).fill(NEVER_BEGINS);
    /** First byte of each page in the pool. */
    this.places = new Float64Array(numPages);
    this.slots = new Int32Array(numPages).fill(NO_SLOT);
    this.lastNeeded = new Int32Array(numPages).fill(-1);
    this.numBelow = new Int32Array(numPages);
    this.hasChanged = true;
  }

  /** @param {number} page */
  isResident(page) {
    return this.shift[page] !== ABSENT_PAGE;
  }

  /**
   * @param {number} page
   * @param {number} place
   * @param {number} frame
   */
  put(page, place, frame) {
    this.shift[page] = 0n;
    this.begins[page] = frame;
    this.places[page] = place;
    this.hasChanged = true;
    const above = this.file.pageAbove(page);
    if (above >= 0) this.numBelow[above] += 1;
  }

  /** @param {number} page */
  remove(page) {
    this.shift[page] = ABSENT_PAGE;
    this.begins[page] = NEVER_BEGINS;
    this.slots[page] = NO_SLOT;
    this.hasChanged = true;
    const above = this.file.pageAbove(page);
    if (above >= 0) this.numBelow[above] -= 1;
  }
}

export class PagePool {
  /**
   * @param {BundleFile[]} files
   * @param {number} bytes Size of the pool.
   */
  constructor(files, bytes) {
    this.pages = files.map((file) => new Pages(file));
    /** First byte of the coarsest page of each bundle. @type {number[]} */
    this.rootPlaces = [];
    let end = 0;
    let slotBytes = 0;
    let numPages = 0;
    for (const file of files) {
      this.rootPlaces.push(end);
      end += file.bytesOf(file.numPages - 1);
      slotBytes = Math.max(slotBytes, file.mostPageBytes);
      numPages += file.numPages - 1;
    }
    if (bytes < end) {
      const needed = `${Math.ceil(end / 2 ** 20)} MiB`;
      throw new UserError(`pool: the coarsest pages of all bundles need ${needed}; raise its size`);
    }
    this.firstSlot = end;
    this.slotBytes = slotBytes;
    const numSlots = Math.min(Math.floor((bytes - end) / slotBytes), numPages);
    /** @type {{ bundle: number, page: number }[]} */
    this.slots = Array.from({ length: numSlots }, () => null);
    this.freeSlots = Array.from({ length: numSlots }, (_, k) => numSlots - 1 - k);
    this.lastArrival = -ARRIVAL_FRAMES;
  }

  /** Bytes of the pool that pages may use. */
  get bytes() {
    return this.firstSlot + this.slotBytes * this.slots.length;
  }

  get numResident() {
    return this.slots.length - this.freeSlots.length;
  }

  /** Places of the pages of each bundle, for layOut(). */
  get places() {
    return this.pages.map(({ places }) => places);
  }

  /**
   * Make the coarsest page of a bundle resident. Returns its place.
   *
   * @param {number} bundle
   */
  putRoot(bundle) {
    const pages = this.pages[bundle];
    pages.put(pages.file.numPages - 1, this.rootPlaces[bundle], -ARRIVAL_FRAMES);
    return this.rootPlaces[bundle];
  }

  /**
   * Store which pages of a bundle the cut of a frame needs. Returns the absent pages. The
   * priority of a page is higher than those of the pages below it.
   *
   * @param {number} bundle
   * @param {Float32Array} needs Priority of each page; 0 if it is not needed.
   * @param {number} frame
   * @returns {Wanted[]}
   */
  recordNeeds(bundle, needs, frame) {
    const pages = this.pages[bundle];
    const { file, lastNeeded } = pages;
    /** @type {Map<number, Wanted>} */
    const wanted = new Map();
    needs.forEach((need, first) => {
      if (need < LEAST_PRIORITY) return;
      let priority = Math.min(need, MOST_PRIORITY);
      for (let page = first; page >= 0; page = file.pageAbove(page)) {
        lastNeeded[page] = frame;
        if (pages.isResident(page)) continue;
        const before = wanted.get(page)?.priority ?? 0;
        if (before < priority) wanted.set(page, { bundle, page, priority });
        priority *= ABOVE;
      }
    });
    return [...wanted.values()];
  }

  /**
   * Whether a page may become resident: it is absent, and the page above is resident.
   *
   * @param {number} bundle
   * @param {number} page
   */
  mayPut(bundle, page) {
    const pages = this.pages[bundle];
    return !pages.isResident(page) && pages.isResident(pages.file.pageAbove(page));
  }

  /**
   * Make a page resident. Returns its place, or -1 if all slots have pages that the last
   * cut needed.
   *
   * @param {number} bundle
   * @param {number} page
   * @param {number} frame
   */
  put(bundle, page, frame) {
    const slot = this.freeSlots.pop() ?? this.evict(frame);
    if (slot === NO_SLOT) return -1;
    const place = this.firstSlot + this.slotBytes * slot;
    this.slots[slot] = { bundle, page };
    this.pages[bundle].put(page, place, frame);
    this.pages[bundle].slots[page] = slot;
    this.lastArrival = frame;
    return place;
  }

  /**
   * Remove a page that the last cut did not need. Returns its slot; NO_SLOT if there is
   * none.
   *
   * @param {number} frame Of the last cut.
   */
  evict(frame) {
    let oldest = NO_SLOT;
    let oldestUse = frame;
    this.slots.forEach(({ bundle, page }, slot) => {
      const { lastNeeded, numBelow } = this.pages[bundle];
      if (numBelow[page] === 0 && lastNeeded[page] < oldestUse) {
        oldest = slot;
        oldestUse = lastNeeded[page];
      }
    });
    if (oldest !== NO_SLOT) {
      const { bundle, page } = this.slots[oldest];
      this.pages[bundle].remove(page);
    }
    return oldest;
  }
}
