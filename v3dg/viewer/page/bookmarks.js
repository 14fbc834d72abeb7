// Bookmarks are links to views of a scene. The browser stores them.

/** @typedef {import("./app.js").App} App */
/** @typedef {{ name: string, hash: string }} Bookmark */

export class Bookmarks {
  /** @type {Bookmark[]} */
  list = [];

  /** @param {App} app */
  constructor(app) {
    this.app = app;
  }

  /** The key under which the browser stores the bookmarks of the scene. */
  get storageKey() {
    return `v3dg:${this.app.scene.name}`;
  }

  /** Loads the bookmarks of the scene. Unreadable ones are skipped. */
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
      this.app.status.warn(
        "This browser stores no bookmarks: they are lost when the tab is closed.",
      );
    }
    this.app.sync();
  }

  /** Adds a bookmark of the current view, named after the camera's position. */
  add() {
    const { app } = this;
    const name = app.camera.position.map((x) => Number(x.toPrecision(3))).join(" ");
    this.list.push({ name, hash: app.linkState.hash });
    this.save();
    app.status.confirm(`Bookmark ${this.list.length} was added.`);
  }

  /**
   * Removes a bookmark by its index.
   *
   * @param {number} index
   */
  remove(index) {
    this.list.splice(index, 1);
    this.save();
  }

  /**
   * Opens the view of a bookmark.
   *
   * @param {number} index
   */
  open(index) {
    const bookmark = this.list[index];
    if (bookmark) this.app.linkState.open(bookmark.hash, "fly");
  }
}
