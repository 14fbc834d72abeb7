// Reads parts of a file from a static server by HTTP ranges. If the server has no
// ranges, the whole file is read once.

/** An error that is reported to the user, in one line. */
export class UserError extends Error {}

/** A server or a network that does not answer. The read may be tried again. */
export class Unreachable extends UserError {}

/** Largest file that is read whole, bytes. */
const MOST_WHOLE_BYTES = 2 ** 29;

/**
 * Return the last part of a URL's path, for messages.
 *
 * @param {string} url
 */
export function nameOf(url) {
  const { pathname } = new URL(url);
  return decodeURIComponent(pathname.slice(pathname.lastIndexOf("/") + 1));
}

export class Source {
  /** Bytes that were received. */
  receivedBytes = 0;
  /** Bytes of the file; known after the first read. */
  size = -1;
  /** The whole file, if the server has no ranges. @type {Uint8Array} */
  whole = null;
  /** The size of the file, and its ETag or its date of modification. @type {string} */
  version = null;

  /** @param {string} url Absolute. */
  constructor(url) {
    this.url = url;
    this.name = nameOf(url);
  }

  /**
   * Return the bytes from `first` to `end`, or to the end of the file if it is shorter.
   *
   * @param {number} first
   * @param {number} end
   * @returns {Promise<Uint8Array>}
   */
  async read(first, end) {
    if (this.whole !== null) return this.whole.slice(first, end);
    const response = await this.request(first, end);
    if (response.status === 206) return this.part(response, first, end);
    if (response.ok) return this.readWhole(response, first, end);
    await response.body?.cancel();
    const status = `${this.name}: the server answered ${response.status}`;
    if (response.status >= 500 || response.status === 429) throw new Unreachable(status);
    if (response.status === 416) throw this.changed();
    throw new UserError(`${status} for ${this.url}`);
  }

  /**
   * @param {number} first
   * @param {number} end
   */
  async request(first, end) {
    try {
      return await fetch(this.url, { headers: { Range: `bytes=${first}-${end - 1}` } });
    } catch {
      throw this.lost();
    }
  }

  /** @param {Response} response */
  async bytesOf(response) {
    try {
      const bytes = new Uint8Array(await response.arrayBuffer());
      this.receivedBytes += bytes.length;
      return bytes;
    } catch {
      throw this.lost();
    }
  }

  /**
   * @param {Response} response
   * @param {number} first
   * @param {number} end
   */
  async part(response, first, end) {
    const range = /^bytes (\d+)-(\d+)\/(\d+)$/.exec(response.headers.get("Content-Range") ?? "");
    if (range === null) {
      const expected = "expected a range of bytes with the file's size";
      throw new UserError(`${this.name}: ${expected} from the server, got none; see its settings`);
    }
    const [, begin, , size] = range.map(Number);
    this.checkVersion(response, size);
    const bytes = await this.bytesOf(response);
    if (begin !== first || bytes.length !== Math.min(end, size) - first) throw this.lost();
    return bytes;
  }

  /**
   * @param {Response} response
   * @param {number} first
   * @param {number} end
   */
  async readWhole(response, first, end) {
    const size = Number(response.headers.get("Content-Length") ?? 0);
    if (size > MOST_WHOLE_BYTES) {
      await response.body?.cancel();
      const limit = `${MOST_WHOLE_BYTES / 2 ** 20} MiB`;
      const problem = `the server has no byte ranges, and the file is larger than ${limit}`;
      throw new UserError(`${this.name}: ${problem}; use a server with ranges`);
    }
    const bytes = await this.bytesOf(response);
    this.checkVersion(response, bytes.length);
    this.whole = bytes;
    return bytes.slice(first, end);
  }

  /**
   * @param {Response} response
   * @param {number} size
   */
  checkVersion(response, size) {
    const { headers } = response;
    const version = `${size} ${headers.get("ETag") ?? headers.get("Last-Modified")}`;
    if (this.version !== null && this.version !== version) throw this.changed();
    this.version = version;
    this.size = size;
  }

  changed() {
    return new UserError(`${this.name}: the file has changed on the server; reload the page`);
  }

  lost() {
    return new Unreachable(`${this.name}: the connection is lost; trying again`);
  }
}
