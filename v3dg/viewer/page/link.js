// The connection to the server, which is made anew when it is lost.

export class Link {
  // `take` is called with each message, and the bytes that came behind it.
  constructor(take, changed) {
    this.take = take;
    this.changed = changed;
    this.connect();
  }

  connect() {
    const url = new URL("connection", location.href);
    url.protocol = url.protocol.replace("http", "ws");
    url.hash = url.search = "";
    this.socket = new WebSocket(url);
    this.socket.binaryType = "arraybuffer";
    this.socket.onopen = () => this.changed(true);
    this.socket.onclose = () => {
      this.changed(false);
      setTimeout(() => this.connect(), 1000);
    };
    this.socket.onmessage = ({ data }) => {
      if (typeof data === "string") return this.take(JSON.parse(data), null);
      const size = new DataView(data).getUint32(0, true);
      this.take(JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, size))), data.slice(4 + size));
    };
  }

  get isFree() {
    return this.socket.readyState === WebSocket.OPEN && this.socket.bufferedAmount < 1 << 16;
  }

  send(message) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
  }

  // A file, a piece at a time, each when the one before is away.
  async sendFile(file, progress) {
    const piece = 1 << 19;
    this.send({ type: "open", name: file.name, size: file.size });
    for (let first = 0; first < file.size; first += piece) {
      const bytes = await file.slice(first, first + piece).arrayBuffer();
      while (this.socket.bufferedAmount > 4 * piece) await new Promise((later) => setTimeout(later, 10));
      if (this.socket.readyState !== WebSocket.OPEN) return;
      this.socket.send(bytes);
      progress(Math.min(first + piece, file.size) / file.size);
    }
  }
}
