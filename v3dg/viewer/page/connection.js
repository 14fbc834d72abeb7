// The connection to the server. If it is lost, it is opened again.

/** @typedef {import("./protocol.js").FromPage} FromPage */
/** @typedef {import("./protocol.js").FromViewer} FromViewer */

const RETRY_MS = 1000;
/** No picture is requested while more bytes than this wait to be sent. */
const MOST_WAITING_BYTES = 1 << 16;
/**
 * Files are sent in pieces of this size. At most this number of pieces may wait to be
 * sent.
 */
const PIECE_BYTES = 1 << 19;
const MOST_WAITING_PIECES = 4;

export class Connection {
  /** @type {WebSocket} */
  socket = null;

  /**
   * Opens the connection.
   *
   * @param {(message: FromViewer, bytes: ArrayBuffer | null) => void} take Called with each
   *   message, and with the binary data that follows it.
   * @param {(isOpen: boolean) => void} changed Called when the connection is opened or
   *   lost.
   */
  constructor(take, changed) {
    this.take = take;
    this.changed = changed;
    this.connect();
  }

  connect() {
    const url = new URL("connection", location.href);
    url.protocol = url.protocol.replace("http", "ws");
    url.hash = "";
    url.search = "";
    this.socket = new WebSocket(url);
    this.socket.binaryType = "arraybuffer";
    this.socket.addEventListener("open", () => this.changed(true));
    this.socket.addEventListener("close", () => {
      this.changed(false);
      setTimeout(() => this.connect(), RETRY_MS);
    });
    this.socket.addEventListener("message", ({ data }) => this.receive(data));
  }

  /**
   * Reads a message. It is either text, or binary data that consists of the length of
   * the text (4 bytes), the text, and more data.
   *
   * @param {string | ArrayBuffer} data
   */
  receive(data) {
    if (typeof data === "string") {
      this.take(JSON.parse(data), null);
      return;
    }
    const size = new DataView(data).getUint32(0, true);
    const text = new TextDecoder().decode(new Uint8Array(data, 4, size));
    this.take(JSON.parse(text), data.slice(4 + size));
  }

  get isOpen() {
    return this.socket.readyState === WebSocket.OPEN;
  }

  /** Whether a message would be sent without delay. */
  get isFree() {
    return this.isOpen && this.socket.bufferedAmount < MOST_WAITING_BYTES;
  }

  /**
   * Sends a message. If there is no connection, the message is lost.
   *
   * @param {FromPage} message
   */
  send(message) {
    if (this.isOpen) this.socket.send(JSON.stringify(message));
  }

  /**
   * Sends a file in pieces. Stops if the connection is lost.
   *
   * @param {File} file
   * @param {(share: number) => void} progress Called with the fraction that has been
   *   sent, 0 to 1.
   */
  async sendFile(file, progress) {
    this.send({ type: "open", name: file.name, size: file.size });
    for (let first = 0; first < file.size; first += PIECE_BYTES) {
      const bytes = await file.slice(first, first + PIECE_BYTES).arrayBuffer();
      while (this.socket.bufferedAmount > MOST_WAITING_PIECES * PIECE_BYTES) {
        await new Promise((resolve) => setTimeout(resolve, 10));
      }
      if (!this.isOpen) return;
      this.socket.send(bytes);
      progress(Math.min(first + PIECE_BYTES, file.size) / file.size);
    }
  }
}
