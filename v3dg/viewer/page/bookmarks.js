// Bookmarks: links to places of a scene, which the browser keeps.

/** @typedef {import("./app.js").App} App */
/** @typedef {{ name: string, hash: string }} Bookmark */

export class Bookmarks {
  /** @type {Bookmark[]} */
  list = [];

  /** @param {App} app */
  constructor(app) {
    this.app = app;
  }

  /** Name under which the browser keeps those of the scene. */
  get storageKey() {
    return `v3dg:${this.app.scene.name}`;
  }

  /** Reads those of the scene; what is not readable is left out. */
  load() {
    /** @type {Bookmark[]} */
    let saved = [];
    try {
      saved = JSON.parse(localStorage.getItem(this.storageKey) ?? "[]");
      this.list = saved.filter(
        ({ name, hash }) => typeof name === "string" && typeof hash === "string",
      );
    } catch {
      this.list = [];
    }
  }

  save() {
    try {
      localStorage.setItem(this.storageKey, JSON.stringify(this.list));
    } catch {
      this.app.status.warn("This browser keeps no bookmarks: they go with the tab.");
    }
    this.app.sync();
  }

  /** Adds one of what is looked at now, named after the camera's position. */
  add() {
    const { app } = this;
    const name = app.camera.position.map((x) => Number(x.toPrecision(3))).join(" ");
    this.list.push({ name, hash: app.linkState.hash });
    this.save();
    app.status.confirm(`Bookmark ${this.list.length} is kept.`);
  }

  /** @param {number} index */
  remove(index) {
    this.list.splice(index, 1);
    this.save();
  }

  /** @param {number} index */
  open(index) {
    const bookmark = this.list[index];
    if (bookmark) this.app.linkState.open(bookmark.hash, "fly");
  }
}
