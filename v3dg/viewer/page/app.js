// The whole page: creates its parts, handles messages from the server, and executes the
// actions of keys and buttons.

import { Bookmarks } from "./bookmarks.js";
import { Camera } from "./camera.js";
import { Connection } from "./connection.js";
import { acceptDrops } from "./drop.js";
import { element, saveFile } from "./elements.js";
import { FileCameras } from "./file_cameras.js";
import { Frames } from "./frames.js";
import { Instances } from "./instances.js";
import { LinkState } from "./link_state.js";
import { Look } from "./look.js";
import { Movement } from "./movement.js";
import { Overlay } from "./overlay.js";
import { Panel } from "./panel.js";
import { CameraPath } from "./path.js";
import { Picture } from "./picture.js";
import { Places } from "./places.js";
import { Pointers } from "./pointers.js";
import { Requests } from "./requests.js";
import { Status } from "./status.js";
import { Toolbar } from "./toolbar.js";

/** @typedef {import("./page.js").Mode} Mode */
/** @typedef {import("./protocol.js").FromViewer} FromViewer */
/** @typedef {import("./protocol.js").Hello} Hello */
/** @typedef {import("./protocol.js").Scene} Scene */
/** @typedef {import("./protocol.js").Settings} Settings */

export class App {
  /**
   * The first message of the server; null until it has arrived.
   *
   * @type {Hello}
   */
  greeting = null;
  /**
   * The scene that is shown; null until the server has described it.
   */
  scene = null;

  camera = new Camera();
  look = new Look(element("stage"), this.camera);
  frames = new Frames(this);
  requests = new Requests(this);
  picture = new Picture(this);
  status = new Status();
  places = new Places(this);
  fileCameras = new FileCameras(this);
  instances = new Instances(this);
  path = new CameraPath(this);
  bookmarks = new Bookmarks(this);
  linkState = new LinkState(this);
  overlay = new Overlay(this);
  crop = this.overlay.crop;
  movement = new Movement(this);
  pointers = new Pointers(this);
  panel = new Panel(this);
  toolbar = new Toolbar(this);
  connection = new Connection(
    (message, bytes) => this.take(message, bytes),
    (isOpen) => this.changeConnection(isOpen),
  );

  constructor() {
    acceptDrops(this);
    new ResizeObserver(() => this.resize()).observe(this.look.stage);
    this.resize();
  }

  get limits() {
    return this.greeting.limits;
  }

  // Messages from the server.

  /**
   * Updates the page after the connection was opened or lost.
   *
   * @param {boolean} isOpen
   */
  changeConnection(isOpen) {
    if (isOpen) this.requests.reset();
    else this.status.say("connecting", "no connection to the viewer");
  }

  /**
   * Handles a message from the server.
   *
   * @param {FromViewer} message
   * @param {ArrayBuffer | null} bytes The binary data that follows the message.
   */
  take(message, bytes) {
    switch (message.type) {
      case "hello":
        this.greet(message);
        break;
      case "scene":
        this.open(message);
        break;
      case "picture":
        this.picture.show(message, bytes);
        break;
      case "failed":
        this.status.say("failed", `not drawn: ${message.text}`);
        break;
      case "notice":
        this.status.warn(message.text);
        break;
      case "progress":
        this.panel.showProgress(message.share);
        break;
      case "done":
        this.panel.hideProgress();
        break;
      case "file":
        saveFile(message.name, bytes);
        break;
      case "picked":
        if (this.crop.isWaiting) this.crop.take(message);
        else this.instances.take(message);
        break;
      case "play":
        this.path.play(message);
        break;
    }
  }

  /**
   * Stores the first message of the server, and shows its scene.
   *
   * @param {Hello} greeting
   */
  greet(greeting) {
    const isFirst = this.greeting === null;
    if (!isFirst && this.greeting.version !== greeting.version) location.reload();
    this.greeting = greeting;
    if (!isFirst) return;
    this.look.begin(greeting);
    this.fileCameras.begin(greeting.cameras);
    this.camera.up = greeting.up;
  }

  /**
   * Shows a scene from its first view, or from the view in the link.
   *
   * @param {Scene} scene
   */
  open(scene) {
    const before = this.scene;
    this.scene = scene;
    this.camera.radius = scene.radius;
    if (before?.name === scene.name) {
      this.redraw();
      return;
    }
    document.title = scene.name;
    this.instances.reset();
    this.crop.reset();
    this.path.reset();
    this.requests.reset();
    this.bookmarks.load();
    if (before) this.openAnother();
    else this.openFirst();
    this.sync();
  }

  openFirst() {
    this.camera.put(this.places.home);
    this.camera.focus = this.places.homeFocus;
    this.panel.build();
    const { hash } = location;
    this.toolbar.showQuestion(this.greeting.asks_up && !/[#&]up=/.test(hash));
    if (hash.length > 1) this.linkState.open(hash);
  }

  openAnother() {
    this.fileCameras.reset();
    this.look.settings.frozen = null;
    this.places.showAll();
    this.panel.build();
    this.toolbar.showQuestion(false);
  }

  // The state of the page.

  resize() {
    const { clientWidth, clientHeight } = this.look.stage;
    if (!clientWidth || !clientHeight) return;
    this.overlay.resize(clientWidth, clientHeight);
    this.redraw();
  }

  redraw() {
    this.frames.redraw();
  }

  /** Updates everything on the page after a change of the state. */
  sync() {
    this.toolbar.sync();
    this.panel.sync();
    this.redraw();
  }

  /**
   * Changes some settings of the picture.
   *
   * @param {Partial<Settings>} settings
   */
  change(settings) {
    Object.assign(this.look.settings, settings);
    this.sync();
  }

  /** Ends the crop if there is one, and otherwise deselects the instance. */
  letGo() {
    if (this.crop.isOn) this.crop.end();
    else this.instances.select(null);
  }

  /**
   * Changes how the camera moves.
   *
   * @param {Mode} mode
   */
  setMode(mode) {
    this.camera.mode = mode;
    document.body.dataset.mode = mode;
    this.sync();
  }
}
