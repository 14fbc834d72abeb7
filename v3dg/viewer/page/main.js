// The viewer's page: it keeps the camera and the settings, asks the server for pictures, and shows them.

import * as M from "./math.js";
import { AXES, Camera } from "./camera.js";
import { Input } from "./input.js";
import { Link } from "./link.js";
import { Overlay } from "./overlay.js";
import { Panel, make } from "./panel.js";

const MOST_RATIO = 2; // px of the picture for one of the page
const MOST_FRAME_SECONDS = 0.1; // a tab that was hidden does not leap
// Where the browser itself takes longer for a frame, as without a GPU, the last picture follows the hand so often only: the
// server may be on the same cores.
const SLOW_FRAME_MS = 25;
const SELDOM_MS = 100;
const MOST_PATH_SECONDS = 600; // which the server takes
const TOOLS = ["move", "turn", "size"];
const MODES = ["orbit", "fly", "walk"];
const element = (id) => document.getElementById(id);
const numbers = (text) => text.split(/[\s,]+/).filter(Boolean).map(Number);
const short = (values) => values.map((x) => +x.toPrecision(7)).join(",");

class App {
  constructor() {
    this.camera = new Camera();
    this.settings = { shows: "appearance", tolerance: 3, budget: null, min_level: 0, gain: 5, fade: null, split: 0, frozen: null };
    this.resolution = 1;
    [this.cameras, this.showsFrusta, this.frustumSize, this.opacity, this.hovered] = [[], false, 0.05, 0.5, -1];
    [this.selected, this.tool, this.held, this.undone] = [null, "move", null, []];
    [this.path, this.secondsOfAView, this.filmSize, this.isRecording] = [[], 2, "1280 x 720", false];
    [this.greeting, this.scene, this.picture, this.asked, this.bookmarks] = [null, null, null, null, []];
    [this.film, this.through, this.needsFrame, this.last, this.number] = [null, null, false, 0, 0];
    [this.frameMs, this.wantedAt, this.placedAt, this.movedAt, this.isNew] = [0, 0, 0, 0, false];
    this.stage = element("stage");
    this.context = element("picture").getContext("bitmaprenderer");
    this.overlay = new Overlay(element("overlay"), element("compass"), this);
    this.input = new Input(element("overlay"), element("pad"), this);
    this.panel = new Panel(element("panel"), this);
    new ResizeObserver(() => this.resize()).observe(this.stage);
    this.addButtons();
    this.addDrop();
    window.addEventListener("hashchange", () => location.hash !== this.hash && this.openHash(location.hash));
    window.addEventListener("gamepadconnected", () => this.redraw());
    if (matchMedia("(max-width: 700px), (max-height: 480px)").matches) this.fold(true);
    this.resize();
    this.link = new Link((message, bytes) => this.take(message, bytes), (isOpen) => this.connected(isOpen));
  }

  // What the server says.

  connected(isOpen) {
    if (isOpen) this.asked = null;
    else this.say("connecting", "no connection to the viewer");
  }

  take(message, bytes) {
    const kinds = {
      hello: () => this.greet(message),
      scene: () => this.open(message),
      picture: () => this.show(message, bytes),
      failed: () => this.say("failed", `not drawn: ${message.text}`),
      notice: () => this.notice(message.text),
      done: () => (this.panel.progress.hidden = true),
      progress: () => {
        this.panel.progress.hidden = false;
        this.panel.progress.value = message.share;
      },
      file: () => {
        const link = make("a", { href: URL.createObjectURL(new Blob([bytes])), download: message.name });
        link.click();
        setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
      },
      picked: () => this.picked(message),
      play: () => {
        this.film = { ...message, start: performance.now() };
        this.redraw();
      },
    };
    kinds[message.type]?.();
  }

  greet(greeting) {
    const isFirst = this.greeting === null;
    if (!isFirst && this.greeting.version !== greeting.version) location.reload();
    this.greeting = greeting;
    if (!isFirst) return;
    this.cameras = greeting.cameras;
    this.showsFrusta = this.cameras.some((camera) => camera.photograph);
    Object.assign(this.settings, greeting.settings);
    this.camera.up = greeting.up;
  }

  open(scene) {
    const isAnother = this.scene === null || this.scene.name !== scene.name;
    const isFirst = this.scene === null;
    this.scene = scene;
    this.camera.radius = scene.radius;
    if (!isAnother) return this.redraw();
    document.title = scene.name;
    [this.selected, this.undone, this.path, this.asked] = [null, [], [], null];
    this.bookmarks = this.load();
    if (isFirst) {
      this.camera.put(this.home);
      this.camera.focus = scene.center;
    } else {
      this.cameras = [];
      this.settings.frozen = null;
      this.showAll();
    }
    this.panel.build();
    if (isFirst && location.hash.length > 1) this.openHash(location.hash);
    element("question").hidden = !(isFirst && this.greeting.asks_up && !/[#&]up=/.test(location.hash));
    this.sync();
  }

  async show(message, bytes) {
    // The second picture for what is no longer looked at: it was on its way when the camera moved.
    if (message.number !== this.number && message.number === this.picture?.number) return;
    const bitmap = await createImageBitmap(new Blob([bytes], { type: "image/jpeg" }));
    const canvas = element("picture");
    [canvas.width, canvas.height] = message.size;
    this.context.transferFromImageBitmap(bitmap);
    [this.picture, this.isNew] = [message, true];
    this.camera.ahead = message.distance ?? this.camera.ahead;
    const now = performance.now();
    if (message.final || !(now - this.figuresAt < 200)) {
      this.panel.show(message);
      this.figuresAt = now;
    }
    this.panel.pace.textContent = `${+this.camera.pace.toPrecision(2)} units a second; the scene's radius is ${+this.scene.radius.toPrecision(3)}`;
    this.sayPicture();
    this.redraw();
  }

  say(state, text) {
    document.body.dataset.state = state;
    element("status").textContent = text;
  }

  // Whether the picture is the one that was asked for, and whole.
  sayPicture() {
    const { size, final } = this.picture;
    const full = this.pictureSize;
    const share = Math.min(1, size[0] / full[0]);
    element("refined").firstElementChild.style.width = `${100 * share}%`;
    if (final && this.picture.number === this.number) this.say("ready", `${size[0]} × ${size[1]}`);
    else this.say(this.isMoving ? "moving" : "refining", `${this.isMoving ? "draft" : "refining"}, ${size[0]} × ${size[1]} of ${full[0]} × ${full[1]}`);
  }

  notice(text, isGood = false) {
    const line = make("p", { className: isGood ? "good" : "" }, text);
    element("notices").append(line);
    setTimeout(() => line.remove(), 7000);
  }

  // What is shown.

  get aspect() { return this.stage.clientWidth / this.stage.clientHeight; }
  get view() { return this.camera.view(this.aspect); }
  get pictureSize() {
    const ratio = Math.min(window.devicePixelRatio || 1, MOST_RATIO) * this.resolution;
    const size = [this.stage.clientWidth, this.stage.clientHeight].map((side) => side * ratio);
    const fit = Math.min(1, 4096 / Math.max(...size));
    return size.map((side) => Math.max(1, Math.round(side * fit)));
  }
  get look() { return { type: "look", view: this.view, size: this.pictureSize, settings: this.settings }; }

  resize() {
    if (!this.stage.clientWidth || !this.stage.clientHeight) return;
    this.overlay.resize(this.stage.clientWidth, this.stage.clientHeight);
    this.redraw();
  }

  // Draw the overlay in the next frame, and ask for a picture if another one is wanted.
  redraw() {
    if (this.needsFrame) return;
    [this.needsFrame, this.wantedAt] = [true, performance.now()];
    requestAnimationFrame((now) => this.frame(now));
  }

  frame(now) {
    this.needsFrame = false;
    if (!this.scene) return;
    const seconds = M.clamp((now - this.last) / 1000, 1e-3, MOST_FRAME_SECONDS);
    if (this.last === this.placedAt) this.frameMs = Math.max(performance.now() - this.wantedAt, 0.9 * this.frameMs);
    this.last = now;
    const isPushed = this.input.advance(seconds);
    this.camera.advance(seconds);
    this.playOn(now);
    if (isPushed || this.camera.flight || this.film) this.redraw();
    if (this.isRecording && !(now - this.recordedAt < 1000 / 30)) this.keep(now);
    this.ask();
    const waited = now - Math.max(this.placedAt, this.movedAt);
    if (this.frameMs > SLOW_FRAME_MS && !this.isNew && waited < SELDOM_MS) return this.redraw();
    [this.isNew, this.placedAt] = [false, now];
    this.place();
    this.overlay.draw();
    return undefined;
  }

  ask() {
    const { look } = this;
    const text = JSON.stringify(look);
    if (text !== this.asked) {
      this.redraw(); // until it is away
      if (!this.link.isFree) return;
      this.number += 1;
      this.link.send({ ...look, number: this.number });
      this.asked = text;
      if (!this.isMoving) this.movedAt = this.last;
      this.isMoving = true;
      clearTimeout(this.resting);
      this.resting = setTimeout(() => this.rest(), 250);
    }
    if (this.picture) this.sayPicture();
  }

  rest() {
    this.isMoving = false;
    if (!this.scene) return;
    history.replaceState(null, "", this.hash);
    this.panel.sync();
    this.redraw();
  }

  same(a, b) {
    const near = (x, y, size) => x.every((value, i) => Math.abs(value - y[i]) <= 1e-9 * size);
    return near(a.wxyz, b.wxyz, 1) && near(a.position, b.position, this.camera.radius + M.length(b.position)) && Math.abs(a.fov_y - b.fov_y) < 1e-9;
  }

  // The last picture where it would be seen from here, until the next one comes.
  place() {
    const canvas = element("picture");
    if (!this.picture) return;
    const { view, distance } = this.picture;
    const isHere = this.same(view, this.view);
    const away = distance ?? this.camera.distance;
    const moved = isHere ? "none" : M.warp(view, this.view, away, this.stage.clientWidth, this.stage.clientHeight);
    canvas.style.transform = moved ?? "none";
    const photograph = element("photograph");
    const isThrough = this.through && this.same(this.through.view, this.view);
    photograph.hidden = !isThrough || this.opacity === 0;
    photograph.style.opacity = this.opacity;
  }

  change(settings) {
    Object.assign(this.settings, settings);
    this.sync();
  }

  changePage({ resolution, speed, fov, up, mode, showsFrusta, frustumSize, opacity }) {
    const { camera } = this;
    if (resolution) this.resolution = resolution;
    if (speed) camera.speed = M.clamp(speed, 0.01, 100);
    if (fov) camera.fov_y = (M.clamp(fov, 1, 170) * Math.PI) / 180;
    if (mode) [camera.mode, document.body.dataset.mode] = [mode, mode];
    if (up && AXES[up]) {
      camera.up = AXES[up];
      camera.level();
    }
    this.showsFrusta = showsFrusta ?? this.showsFrusta;
    this.frustumSize = frustumSize ?? this.frustumSize;
    this.opacity = opacity ?? this.opacity;
    this.sync();
  }

  // Have all that is seen follow what was set.
  sync() {
    for (const button of document.querySelectorAll("[data-mode][role], [data-tool]")) {
      const isOn = button.dataset.mode === this.camera.mode || button.dataset.tool === this.tool;
      button.setAttribute("aria-checked", String(isOn));
    }
    for (const button of document.querySelectorAll("[data-up]")) button.setAttribute("aria-checked", String(button.dataset.up === this.upAxis));
    element("tools").hidden = !this.selected;
    this.panel.sync();
    this.redraw();
  }

  fold(isFolded) {
    document.body.classList.toggle("folded", isFolded);
    element("menu").setAttribute("aria-expanded", String(!isFolded));
  }

  addButtons() {
    const dismiss = () => (element("question").hidden = true);
    const acts = { undo: () => this.undo(), deselect: () => this.select(null), dismiss };
    for (const axis of Object.keys(AXES)) {
      element("question").lastElementChild.before(make("button", { role: "radio", "data-up": axis, title: `${axis} is up` }, axis));
    }
    document.body.dataset.mode = this.camera.mode;
    for (const button of document.querySelectorAll("#stage button")) {
      const { mode, tool, act, up } = button.dataset;
      button.addEventListener("click", () => {
        if (mode) this.changePage({ mode });
        if (tool) this.tool = tool;
        if (up) {
          this.changePage({ up });
          this.showAll();
        }
        acts[act]?.();
        this.sync();
      });
    }
    element("menu").addEventListener("click", () => this.fold(!document.body.classList.contains("folded")));
  }

  // A key that is no way to fly; returns whether it means something.
  command(event) {
    if (!this.scene) return false;
    if (event.ctrlKey || event.metaKey) {
      if (event.code !== "KeyZ") return false;
      this.undo();
      return true;
    }
    const { camera } = this;
    const next = () => this.changePage({ mode: MODES[(MODES.indexOf(camera.mode) + 1) % MODES.length] });
    const tool = (name) => () => {
      this.tool = name;
      this.sync();
    };
    const keys = {
      KeyH: () => this.showAll(), KeyL: () => this.level(), KeyM: next, KeyB: () => this.addBookmark(),
      KeyP: () => element("menu").click(), KeyF: () => this.flyToSelected(), Escape: () => this.select(null),
      KeyG: tool(TOOLS[0]), KeyR: tool(TOOLS[1]), KeyT: tool(TOOLS[2]),
    };
    const isDigit = /^Digit[1-9]$/.test(event.code);
    if (isDigit) this.openBookmark(Number(event.code.at(-1)) - 1);
    else if (event.key === "+" || event.key === "=") this.changePage({ speed: camera.speed * 1.5 });
    else if (event.key === "-") this.changePage({ speed: camera.speed / 1.5 });
    else if (event.code in keys) keys[event.code]();
    else return false;
    return true;
  }

  // Places.

  get upAxis() {
    const { up } = this.camera;
    return Object.keys(AXES).find((axis) => M.dot(AXES[axis], M.unit(up)) > 0.9999) ?? "other";
  }

  level() {
    this.camera.level();
    this.redraw();
  }

  // All of the scene, from a little above, whichever axis is up.
  get home() {
    const { scene, camera } = this;
    const home = this.greeting.home;
    const isHome = M.dot(M.unit(this.greeting.up), M.unit(camera.up)) > 0.9999;
    const fov_y = Math.PI / 4;
    let forward = M.rotate(home.wxyz, [0, 0, 1]);
    if (!isHome) {
      const side = M.unit(M.cross(camera.up, Math.abs(camera.up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0]));
      forward = M.add(M.mul(side, Math.cos(0.45)), M.mul(camera.up, -Math.sin(0.45)));
    }
    // A window that is higher than wide shows less at its sides.
    const half = Math.atan(Math.tan(fov_y / 2) * Math.min(1, this.aspect));
    const distance = (0.95 * scene.radius) / Math.sin(half);
    const position = M.sub(scene.center, M.mul(forward, distance));
    return { wxyz: M.looking(forward, camera.up), position, fov_y };
  }

  showAll() {
    this.camera.flyTo(this.home, this.scene.center);
    this.redraw();
  }

  goTo(text) {
    const wanted = text.trim();
    const camera = this.cameras.findIndex(({ name }) => name === wanted);
    const point = numbers(wanted);
    if (camera >= 0) return this.lookThrough(camera);
    if (/^#\d+$/.test(wanted)) {
      if (Number(wanted.slice(1)) >= this.scene.instances) return this.notice(`Go to: expected #0 to #${this.scene.instances - 1}, got ${wanted}`);
      this.fliesToPicked = true;
      this.link.send({ type: "pick", look: this.look, instance: Number(wanted.slice(1)) });
      return undefined;
    }
    if (point.length === 3 && point.every(Number.isFinite)) {
      this.camera.lookAt(point, Math.min(this.camera.distance, 0.25 * this.scene.radius));
      return this.redraw();
    }
    return this.notice(`Go to: expected x y z, #instance or a camera's name, got ${wanted || "nothing"}`);
  }

  lookThrough(i) {
    const { view, photograph } = this.cameras[i];
    const { clientWidth: width, clientHeight: height } = this.stage;
    const fits = Math.tan(view.fov_y / 2) * Math.max(1, view.aspect / this.aspect);
    const seen = { ...view, fov_y: 2 * Math.atan(fits), aspect: this.aspect };
    const focus = M.add(view.position, M.mul(M.rotate(view.wxyz, [0, 0, 1]), Math.max(this.ahead(view), 0.05 * this.scene.radius)));
    this.camera.flyTo(seen, focus);
    this.through = null;
    if (photograph) {
      const image = element("photograph");
      const high = (height * Math.tan(view.fov_y / 2)) / fits;
      const wide = high * view.aspect;
      const box = { left: (width - wide) / 2, top: (height - high) / 2, width: wide, height: high };
      for (const [name, px] of Object.entries(box)) image.style[name] = `${px}px`;
      image.src = `photograph/${i}`;
      this.through = { view: seen };
    }
    this.redraw();
  }

  // How far along a view's axis the middle of the scene is.
  ahead(view) {
    return M.dot(M.sub(this.scene.center, view.position), M.rotate(view.wxyz, [0, 0, 1]));
  }

  get hash() {
    const { camera, settings } = this;
    const parts = {
      at: short(camera.position), turn: short(camera.wxyz), focus: short(camera.focus),
      fov: +((camera.fov_y * 180) / Math.PI).toPrecision(5), up: this.upAxis === "other" ? short(camera.up) : this.upAxis,
      mode: camera.mode, speed: +camera.speed.toPrecision(3), show: settings.shows, tolerance: settings.tolerance,
      budget: settings.budget ?? "", level: settings.min_level, gain: settings.gain, fade: settings.fade === null ? 0 : 1, split: settings.split,
      resolution: this.resolution,
    };
    const usual = { mode: "orbit", speed: 1, show: "appearance", budget: "", level: 0, gain: 5, fade: 1, split: 0, resolution: 1 };
    const told = Object.entries(parts).filter(([name, value]) => usual[name] !== value);
    return `#${told.map(([name, value]) => `${name}=${value}`).join("&")}`;
  }

  // Go where a link leads; what it does not say, or says wrongly, stays.
  openHash(hash, flies = false) {
    const given = Object.fromEntries(new URLSearchParams(hash.replace(/^#/, "")));
    const list = (name, count) => {
      const values = numbers(given[name] ?? "");
      return values.length === count && values.every(Number.isFinite) ? values : null;
    };
    const number = (name, low, high) => {
      const value = given[name] === undefined || given[name] === "" ? NaN : Number(given[name]);
      return Number.isFinite(value) ? M.clamp(value, low, high) : null;
    };
    const { camera, settings } = this;
    camera.up = AXES[given.up] ?? list("up", 3) ?? camera.up;
    const [position, turn, focus, fov] = [list("at", 3), list("turn", 4), list("focus", 3), number("fov", 1, 170)];
    if (position && turn && M.length(turn) > 0.5) {
      const view = { position, wxyz: M.unit(turn), fov_y: fov ? (fov * Math.PI) / 180 : camera.fov_y };
      if (flies) {
        camera.flyTo(view, focus);
      } else {
        camera.put(view);
        camera.focus = focus ?? camera.focus;
      }
    }
    if (MODES.includes(given.mode ?? "orbit")) this.changePage({ mode: given.mode ?? "orbit" });
    const last = Math.max(this.scene.level_colors.length - 1, 0);
    const { modes, shows_cuts } = this.scene; // what a link may ask for that cannot be shown here
    const shows = given.show ?? "appearance", split = number("split", 0, 1) ?? 0;
    if (!modes.includes(shows)) this.notice(`The link's mode ${shows} is not there; ${modes.join(", ")} are.`);
    if (split && !shows_cuts) this.notice("The link's split is not there: a pool on a GPU has none.");
    Object.assign(settings, {
      shows: modes.includes(shows) ? shows : settings.shows,
      tolerance: number("tolerance", 0, 1e6) ?? settings.tolerance,
      budget: number("budget", 1, 1e12) === null ? null : Math.round(number("budget", 1, 1e12)),
      min_level: Math.round(number("level", 0, last) ?? 0),
      gain: number("gain", 1, 50) ?? 5,
      fade: given.fade === "0" ? null : this.greeting.settings.fade,
      split: shows_cuts ? split : 0,
    });
    this.resolution = number("resolution", 0.1, 1) ?? 1;
    camera.speed = number("speed", 0.01, 100) ?? 1;
    this.sync();
  }

  async copyLink() {
    const url = location.href.split("#")[0] + this.hash;
    history.replaceState(null, "", this.hash);
    try {
      await navigator.clipboard.writeText(url);
      this.notice("The link is in the clipboard.", true);
    } catch {
      this.notice("The link is in the address bar.", true); // where a page may not use the clipboard
    }
  }

  get storage() { return `v3dg:${this.scene.name}`; }

  load() {
    try {
      const kept = JSON.parse(localStorage.getItem(this.storage) ?? "[]");
      return kept.filter(({ name, hash }) => typeof name === "string" && typeof hash === "string");
    } catch {
      return [];
    }
  }

  keepBookmarks() {
    try {
      localStorage.setItem(this.storage, JSON.stringify(this.bookmarks));
    } catch {
      this.notice("This browser keeps no bookmarks: they go with the tab.");
    }
    this.sync();
  }

  addBookmark() {
    const place = this.camera.position.map((x) => +x.toPrecision(3)).join(" ");
    this.bookmarks.push({ name: place, hash: this.hash });
    this.keepBookmarks();
    this.notice(`Bookmark ${this.bookmarks.length} is kept.`, true);
  }

  removeBookmark(i) {
    this.bookmarks.splice(i, 1);
    this.keepBookmarks();
  }

  openBookmark(i) {
    if (this.bookmarks[i]) this.openHash(this.bookmarks[i].hash, true);
  }

  // Instances.

  pick(x, y, flies) {
    if (!this.scene.shows_cuts) return;
    this.fliesToPicked = flies;
    this.link.send({ type: "pick", look: this.look, at: [M.clamp(x, 0, 1), M.clamp(y, 0, 1)] });
  }

  picked(message) {
    if (message.instance === undefined) return this.select(null);
    const { camera, scene } = this;
    this.select(scene.instances > 1 ? message : null);
    const point = message.point ?? message.pose.position;
    const size = message.pose.scale * M.length(M.sub(message.box[1], message.box[0]));
    if (!this.fliesToPicked) camera.focus = point;
    else if (message.point) camera.lookAt(point, 0.35 * M.length(M.sub(camera.position, point)));
    else camera.lookAt(point, 1.5 * size);
    return this.redraw();
  }

  select(found) {
    this.selected = found;
    this.sync();
  }

  flyToSelected() {
    if (!this.selected) return this.camera.lookAt(this.camera.focus, this.camera.distance);
    const { pose, box } = this.selected;
    this.camera.lookAt(pose.position, 1.5 * pose.scale * M.length(M.sub(box[1], box[0])));
    return this.redraw();
  }

  setPose(pose) {
    this.selected.pose = pose;
    this.sendPose(this.selected.instance, pose);
  }

  sendPose(instance, { position, quaternion, scale }) {
    this.link.send({ type: "move", instance, position, quaternion, scale });
    this.asked = null; // what is shown has changed
    this.number += 1;
    this.sayPicture();
    this.redraw();
  }

  letGo() {
    this.undone.push({ instance: this.selected.instance, pose: this.held.pose });
    this.held = null;
    this.sync();
  }

  undo() {
    const before = this.undone.pop();
    if (!before) return;
    if (this.selected?.instance === before.instance) this.selected.pose = before.pose;
    this.sendPose(before.instance, before.pose);
    this.sync();
  }

  // Paths, and what is saved.

  addStop() {
    if (this.isRecording) return;
    this.path.push([this.secondsOfAView, this.view]);
    this.sync();
  }

  clearPath() {
    this.path = [];
    this.isRecording = false;
    this.panel.record.set(false);
    this.sync();
  }

  record(isOn) {
    if (isOn) [this.path, this.recordedAt] = [[], undefined];
    else this.keep(performance.now()); // to end where the camera rests
    this.isRecording = isOn;
    this.sync();
  }

  keep(now) {
    const last = this.path.at(-1);
    if (last && this.same(last[1], this.view)) return;
    this.path.push([this.recordedAt === undefined ? 0.01 : M.clamp((now - this.recordedAt) / 1000, 0.01, MOST_PATH_SECONDS), this.view]);
    this.recordedAt = now;
  }

  save(what) {
    if (this.path.reduce((sum, [seconds]) => sum + seconds, 0) > MOST_PATH_SECONDS) return this.notice("Path: expected at most ten minutes; clear it");
    const look = structuredClone(this.look);
    if (what === "film" && this.filmSize !== "as the window") look.size = this.filmSize.split(" x ").map(Number);
    const axis = this.upAxis === "other" ? null : this.upAxis;
    this.link.send({ type: "save", what, look, up: axis, path: this.path });
    return undefined;
  }

  stop() {
    this.film = null;
    this.link.send({ type: "stop" });
  }

  playOn(now) {
    if (!this.film) return;
    const { views, fps, start } = this.film;
    const place = Math.min(((now - start) / 1000) * fps, views.length - 1);
    this.camera.put(views[Math.floor(place)]);
    if (place >= views.length - 1) this.film = null;
  }

  // Files that are dropped.

  addDrop() {
    const sign = element("drop");
    window.addEventListener("dragover", (event) => {
      event.preventDefault();
      sign.hidden = false;
    });
    window.addEventListener("dragleave", (event) => event.relatedTarget === null && (sign.hidden = true));
    window.addEventListener("drop", async (event) => {
      event.preventDefault();
      sign.hidden = true;
      const [file] = event.dataTransfer.files;
      if (!file) return;
      this.say("refining", `sending ${file.name}`);
      await this.link.sendFile(file, (share) => this.say("refining", `sending ${file.name}, ${Math.round(100 * share)} %`));
    });
  }
}

window.viewer = new App();
