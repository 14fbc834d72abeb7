// The panel: controls that change the page's settings, and figures of the last picture.

export const SHOWS = {
  appearance: "Colour",
  level: "Level",
  cluster: "Cluster",
  error: "Error",
  residency: "Residency",
  depth: "Depth",
  alpha: "Alpha",
  count: "Gaussians per pixel",
  difference: "Difference to all gaussians",
};
const NEED_LEVELS = ["level", "error", "difference"];
const KEYS = [
  ["drag", "turn"], ["right or Shift drag, two fingers", "move sideways"], ["wheel, pinch", "near and far"],
  ["click", "turn around this, select its instance"], ["double click", "fly there"], ["W A S D Q E", "fly"],
  ["Shift, Alt", "faster, slower"], ["+ −", "speed"], ["M", "orbit, fly, walk"], ["H", "show all"],
  ["F", "fly to what is selected"], ["L", "stand upright"], ["B, 1 … 9", "keep a bookmark, go to it"],
  ["G R T", "move, turn, scale the instance"], ["Ctrl+Z", "take back"], ["Esc", "let go"], ["P", "panel"],
];

export function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name in element) element[name] = value;
    else element.setAttribute(name, value);
  }
  element.append(...children);
  return element;
}

export class Panel {
  constructor(root, app) {
    this.root = root;
    this.app = app;
  }

  labelled(parent, label, control, title, output) {
    control.setAttribute("aria-label", label);
    const element = make("label", { title: title ?? "" }, make("span", {}, label), output ?? "", control);
    parent.append(element);
    return element;
  }

  // A slider of a value; `power` spreads the small ones: 1 for evenly, 0 for a logarithm.
  slider(parent, label, { low, high, step, value, log = false, text = (x) => `${+x.toPrecision(3)}`, title }, act) {
    const [to, back] = log ? [Math.log, Math.exp] : [(x) => x, (x) => x];
    const output = make("output", {}, text(value));
    const range = { type: "range", min: to(low), max: to(high), step: log ? 0.01 : step };
    const control = make("input", range);
    control.value = to(value);
    const element = this.labelled(parent, label, control, title, output);
    control.addEventListener("input", () => {
      const value = back(Number(control.value));
      output.textContent = text(value);
      act(value);
    });
    element.set = (value) => {
      control.value = to(value);
      output.textContent = text(value);
    };
    return element;
  }

  checkbox(parent, label, value, title, act) {
    const control = make("input", { type: "checkbox", checked: value });
    control.addEventListener("change", () => act(control.checked));
    const element = this.labelled(parent, label, control, title);
    element.set = (value) => (control.checked = value);
    return element;
  }

  select(parent, label, options, value, act, title) {
    const control = make("select", {}, ...options.map(([key, text]) => make("option", { value: key }, text)));
    control.value = value;
    control.addEventListener("change", () => act(control.value));
    const element = this.labelled(parent, label, control, title);
    element.set = (value) => (control.value = value);
    return element;
  }

  button(parent, label, act, title = "") {
    const element = make("button", { type: "button", title }, label);
    element.addEventListener("click", act);
    parent.append(element);
    return element;
  }

  folder(title, isOpen) {
    const element = make("details", { open: isOpen }, make("summary", {}, title));
    this.root.append(element);
    return element;
  }

  row(parent) {
    const element = make("div", { className: "row" });
    parent.append(element);
    return element;
  }

  // All of it anew, for a scene.
  build() {
    const { app } = this;
    this.root.replaceChildren(make("h1", {}, app.scene.name));
    this.figures = make("div");
    this.root.append(this.figures);
    this.addPicture(this.folder("Picture", true));
    this.addMovement(this.folder("Movement", true));
    this.addPlaces(this.folder("Places", false));
    if (app.cameras.length) this.addCameras(this.folder("Cameras of the file", false));
    this.addInstances(this.folder("Instances", false));
    this.addPath(this.folder("Path", false));
    const help = this.folder("Keys", false);
    help.append(make("table", {}, ...KEYS.map(([key, does]) => make("tr", {}, make("td", {}, make("kbd", {}, key)), make("td", {}, does)))));
    this.sync();
  }

  addPicture(parent) {
    const { app } = this;
    const { settings } = app;
    const hasLevels = app.scene.level_colors.length > 1;
    const canShow = (shows) => app.scene.modes.includes(shows) && (hasLevels || !NEED_LEVELS.includes(shows));
    const modes = Object.entries(SHOWS).filter(([shows]) => canShow(shows));
    const change = (name) => (value) => app.change({ [name]: value });
    this.shows = this.select(parent, "Show", modes, settings.shows, change("shows"));
    this.gain = this.slider(parent, "Amplify", { low: 1, high: 50, step: 1, value: settings.gain }, change("gain"));
    const levels = make("div", { hidden: !hasLevels });
    parent.append(levels);
    this.tolerance = this.slider(levels, "Tolerance px²", {
      low: 0, high: Math.max(32, settings.tolerance), step: 0.25, value: settings.tolerance,
      title: "Screen area that one gaussian of a coarser cluster may stand for; 0 draws all.",
    }, change("tolerance"));
    this.limits = this.checkbox(levels, "Limit gaussians", settings.budget !== null,
      "The tolerance is raised until no more than so many are selected.", (isLimited) => {
        const tolerance = isLimited ? 0 : settings.tolerance || 3;
        app.change({ budget: isLimited ? 2e6 : null, tolerance });
      });
    this.budget = this.slider(levels, "Millions", {
      low: Math.min(0.01, (settings.budget ?? 1e6) / 1e6), high: Math.max(20, (settings.budget ?? 0) / 1e6), log: true,
      value: (settings.budget ?? 2e6) / 1e6,
    }, (millions) => app.change({ budget: Math.max(1, Math.round(1e6 * millions)) }));
    this.minLevel = this.slider(levels, "Finest level", {
      low: 0, high: Math.max(app.scene.level_colors.length - 1, 1), step: 1, value: settings.min_level,
    }, change("min_level"));
    this.fade = this.checkbox(levels, "Fade", settings.fade !== null,
      "A level comes as the other goes, so that nothing pops while the camera moves.",
      (on) => app.change({ fade: on ? app.greeting.settings.fade : null }));
    this.split = this.slider(levels, "Split", {
      low: 0, high: 1, step: 0.01, value: settings.split, title: "All gaussians on the left, the cut on the right.",
    }, change("split"));
    this.freeze = this.checkbox(levels, "Freeze the cut", settings.frozen !== null,
      "Keep what this camera needs, and fly around it.", (on) => app.change({ frozen: on ? app.view : null }));
    this.resolution = this.slider(parent, "Resolution %", {
      low: 10, high: 100, step: 5, value: 100 * app.resolution, title: "Of the window, at rest; while moving it follows the speed.",
    }, (percent) => app.changePage({ resolution: percent / 100 }));
    this.button(this.row(parent), "Save picture", () => app.save("picture"), "A .png of what is shown, in full");
  }

  addMovement(parent) {
    const { app } = this;
    this.speed = this.slider(parent, "Speed", {
      low: 0.02, high: 20, log: true, value: app.camera.speed, text: (x) => `× ${+x.toPrecision(2)}`,
      title: "Of flying and walking. At 1 it suits the scene's size, and what is near.",
    }, (speed) => app.changePage({ speed }));
    this.fov = this.slider(parent, "Field of view", {
      low: 10, high: 120, step: 1, value: 45, text: (x) => `${Math.round(x)}°`,
    }, (degrees) => app.changePage({ fov: degrees }));
    const axes = ["z", "y", "x", "-z", "-y", "-x"].map((axis) => [axis, axis]);
    this.up = this.select(parent, "Up", [...axes, ["other", "other"]], app.upAxis, (axis) => app.changePage({ up: axis }),
      "The axis that is upright: orbits go around it.");
    const row = this.row(parent);
    this.button(row, "Show all", () => app.showAll(), "H");
    this.button(row, "Level", () => app.level(), "Stand upright (L)");
    this.pace = make("p", { className: "faint" });
    parent.append(this.pace);
  }

  addPlaces(parent) {
    const { app } = this;
    this.goTo = make("input", { type: "text", placeholder: "x y z, or #12, or a camera's name" });
    this.labelled(parent, "Go to", this.goTo, "A point, an instance by its number, or a camera");
    this.goTo.addEventListener("keydown", (event) => event.key === "Enter" && app.goTo(this.goTo.value));
    const row = this.row(parent);
    this.button(row, "Go", () => app.goTo(this.goTo.value));
    this.button(row, "Add bookmark", () => app.addBookmark(), "B");
    this.button(row, "Copy link", () => app.copyLink(), "An address that leads here, with these settings");
    this.bookmarks = make("ul");
    parent.append(this.bookmarks);
  }

  addCameras(parent) {
    const { app } = this;
    const names = app.cameras.map((camera, i) => [String(i), camera.name]);
    this.camera = this.select(parent, "Of the file", [["", ""], ...names], "", (i) => i !== "" && app.lookThrough(Number(i)));
    this.frusta = this.checkbox(parent, "Show as frusta", app.showsFrusta, "Click one to look through it", (on) => app.changePage({ showsFrusta: on }));
    this.slider(parent, "Size of frusta", { low: 0.005, high: 0.5, log: true, value: app.frustumSize }, (size) => app.changePage({ frustumSize: size }));
    if (app.cameras.some((camera) => camera.photograph)) {
      this.slider(parent, "Photograph %", { low: 0, high: 100, step: 5, value: 100 * app.opacity }, (percent) => app.changePage({ opacity: percent / 100 }));
    }
  }

  addInstances(parent) {
    const { app } = this;
    this.selected = make("p", { className: "faint" });
    parent.append(this.selected);
    const row = this.row(parent);
    this.button(row, "Undo", () => app.undo(), "Ctrl+Z");
    if (app.scene.has_files) this.button(row, "Save scene (.json)", () => app.save("scene"), "The instances as they stand now, with the path's cameras");
  }

  addPath(parent) {
    const { app } = this;
    this.path = make("p", { className: "faint" });
    parent.append(this.path);
    this.slider(parent, "Seconds a view", { low: 0.5, high: 10, step: 0.5, value: app.secondsOfAView }, (seconds) => (app.secondsOfAView = seconds));
    const row = this.row(parent);
    this.button(row, "Add this view", () => app.addStop());
    this.button(row, "Clear", () => app.clearPath());
    this.button(row, "Play", () => app.save("play"));
    this.record = this.checkbox(parent, "Record", false, "Keep every view while you fly.", (on) => app.record(on));
    const sizes = ["1280 x 720", "1920 x 1080", "as the window"].map((size) => [size, size]);
    this.select(parent, "Size", sizes, app.filmSize, (size) => (app.filmSize = size));
    const files = this.row(parent);
    this.button(files, "Save film (.mp4)", () => app.save("film"));
    this.button(files, "Save cameras (transforms.json)", () => app.save("cameras"));
    this.button(files, "Stop", () => app.stop());
    this.progress = make("progress", { max: 1, value: 0, hidden: true });
    parent.append(this.progress);
  }

  // Have the controls say what is so.
  sync() {
    if (!this.shows) return;
    const { app } = this;
    const { settings, camera } = app;
    this.shows.set(settings.shows);
    this.gain.set(settings.gain);
    this.gain.hidden = settings.shows !== "difference";
    this.tolerance.set(settings.tolerance);
    this.limits.set(settings.budget !== null);
    this.budget.hidden = settings.budget === null;
    if (settings.budget !== null) this.budget.set(settings.budget / 1e6);
    this.minLevel.set(settings.min_level);
    this.fade.set(settings.fade !== null);
    this.split.set(settings.split);
    this.freeze.set(settings.frozen !== null);
    for (const control of [this.split, this.freeze]) control.hidden = !app.scene.shows_cuts;
    this.resolution.set(100 * app.resolution);
    this.speed.set(camera.speed);
    this.fov.set((camera.fov_y * 180) / Math.PI);
    this.up.set(app.upAxis);
    this.frusta?.set(app.showsFrusta);
    const count = app.path.length;
    const seconds = app.path.slice(1).reduce((sum, [pause]) => sum + pause, 0);
    this.path.textContent = count ? `${count} views, ${seconds.toFixed(1)} s` : "no views yet";
    const { selected, scene } = app;
    const text = (numbers) => numbers.map((x) => +x.toPrecision(4)).join(" ");
    this.selected.textContent = selected
      ? `#${selected.instance} of ${scene.instances.toLocaleString("en")}: ${selected.bundle || "asset"}, at ${text(selected.pose.position)}, scale ${text([selected.pose.scale])}`
      : `${scene.instances.toLocaleString("en")} in the scene${scene.shows_cuts ? "; click one to select it" : ""}`;
    const items = app.bookmarks.map((bookmark, i) => {
      const item = make("li");
      this.button(item, `${i + 1}  ${bookmark.name}`, () => app.openBookmark(i));
      this.button(item, "✕", () => app.removeBookmark(i), "Remove");
      return item;
    });
    this.bookmarks.replaceChildren(...items);
  }

  // What the last picture cost, and what its colours mean.
  show(picture) {
    const { figures, size } = picture;
    const number = (x) => x.toLocaleString("en");
    const rows = [
      ["selected", number(figures.gaussians_selected)],
      ["in the frustum", number(figures.gaussians_in_frustum)],
      ["tolerance", `${+figures.tolerance.toPrecision(3)} px²`],
      ["select", `${figures.select_ms.toFixed(1)} ms`],
      ["draw", `${figures.draw_ms.toFixed(1)} ms`],
      ["picture", `${size[0]} x ${size[1]}`],
      ...(figures.missing ? [["pages missing", number(figures.missing)]] : []),
      ["memory", `${number(Math.round(figures.memory_bytes / 2 ** 20))} MiB`],
    ];
    const table = make("table", {}, ...rows.map((row) => make("tr", {}, ...row.map((cell) => make("td", {}, cell)))));
    this.figures.replaceChildren(table, ...this.legend(picture), ...this.levels(figures.levels));
  }

  legend({ shows, range }) {
    if (shows === "residency") {
      const [there, ...missing] = this.app.scene.missing_colors.map((color) => `rgb(${color})`);
      return this.bar(`${there} 25%, ${missing[0]} 25%, ${missing.slice(1).join(",")}`, ["as wanted", "finer pages missing"]);
    }
    if (!range) return [];
    const short = (x) => `${+x.toPrecision(3)}`;
    let marks = range.map(short);
    if (shows === "count") marks = ["1", "4", "16", "64", `${this.app.scene.most_counted}+`];
    if (shows === "error") marks = ["finest", `tolerance, ${marks[1]} px²`];
    if (shows === "depth") marks = [`far ${marks[0]}`, `near ${marks[1]}`];
    const colors = shows === "alpha" ? ["#000", "#fff"] : this.app.scene.ramp.map((color) => `rgb(${color})`);
    return this.bar(colors.join(","), marks);
  }

  bar(colors, marks) {
    const ramp = make("div", { className: "ramp" });
    ramp.style.background = `linear-gradient(90deg, ${colors})`;
    return [ramp, make("div", { className: "marks" }, ...marks.map((mark) => make("span", {}, mark)))];
  }

  levels(levels) {
    if (levels.length < 2) return [];
    const most = Math.max(...levels, 1);
    const bars = levels.map((count, level) => {
      const bar = make("div", { title: `level ${level}: ${count.toLocaleString("en")}` });
      bar.style.height = `${Math.max((100 * count) / most, 1)}%`;
      bar.style.background = `rgb(${this.app.scene.level_colors[level]})`;
      return bar;
    });
    const marks = ["level 0", "selected by level", String(levels.length - 1)].map((mark) => make("span", {}, mark));
    return [make("div", { className: "levels" }, ...bars), make("div", { className: "marks" }, ...marks)];
  }
}
