// What is drawn over the picture: frusta of cameras, the box of a selected instance, handles that move it.

import * as M from "./math.js";
import { AXES } from "./camera.js";

const COLORS = ["#ff6b5e", "#7ad97a", "#5aa9ff"];
const REACH = 85; // px, of handles
const MOST_THUMBNAILS = 40;
const RING = [...Array(49).keys()].map((i) => (2 * Math.PI * i) / 48);

export class Overlay {
  constructor(canvas, compass, app) {
    this.canvas = canvas;
    this.app = app;
    this.context = canvas.getContext("2d");
    this.arms = compass.getContext("2d");
    this.thumbnails = new Map();
  }

  resize(width, height) {
    const ratio = window.devicePixelRatio || 1;
    [this.canvas.width, this.canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)];
    this.context.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.arms.canvas.width = this.arms.canvas.height = Math.round(80 * ratio);
    this.arms.setTransform(ratio, 0, 0, ratio, 0, 0);
    [this.width, this.height] = [width, height];
  }

  // From the world to right, down and depth of the camera.
  seen(point) {
    const { camera } = this.app;
    return M.rotate(M.inverse(camera.wxyz), M.sub(point, camera.position));
  }

  get focal() { return this.height / 2 / Math.tan(this.app.camera.fov_y / 2); }

  // Where a point is in the picture, px; null behind the camera.
  place(point) {
    const [x, y, z] = this.seen(point);
    if (z < 1e-6 * this.app.camera.radius) return null;
    return [this.width / 2 + (this.focal * x) / z, this.height / 2 + (this.focal * y) / z];
  }

  line(a, b) {
    const near = 1e-4 * this.app.camera.radius;
    let [p, q] = [this.seen(a), this.seen(b)];
    if (p[2] < near && q[2] < near) return;
    if (p[2] < near) p = M.mix(q, p, (q[2] - near) / (q[2] - p[2]));
    if (q[2] < near) q = M.mix(p, q, (p[2] - near) / (p[2] - q[2]));
    const at = ([x, y, z]) => [this.width / 2 + (this.focal * x) / z, this.height / 2 + (this.focal * y) / z];
    this.context.moveTo(...at(p));
    this.context.lineTo(...at(q));
  }

  stroke(color, width, lines) {
    const { context } = this;
    context.strokeStyle = color;
    context.lineWidth = width;
    context.beginPath();
    for (const [a, b] of lines) this.line(a, b);
    context.stroke();
  }

  draw() {
    const { app } = this;
    if (this.width > 700) this.compass();
    // A layer that shows nothing is not blended over the picture, which takes long where there is no GPU.
    const isEmpty = !app.settings.frozen && !app.showsFrusta && !app.selected;
    this.canvas.style.opacity = isEmpty ? 0 : 1;
    if (isEmpty) return;
    this.context.clearRect(0, 0, this.width, this.height);
    // Browsers may not show a frame that is only cleared.
    this.context.fillStyle = "#00000003";
    this.context.fillRect(0, 0, 1, 1);
    if (app.settings.frozen) this.frustum(app.settings.frozen, 0.08 * app.camera.radius, "#ffbe3c", 2);
    if (app.showsFrusta) this.frusta();
    if (app.selected) this.selection();
  }

  corners(view, depth) {
    const y = depth * Math.tan(view.fov_y / 2);
    const x = y * view.aspect;
    return [[-x, -y], [x, -y], [x, y], [-x, y]].map(([a, b]) => M.add(view.position, M.rotate(view.wxyz, [a, b, depth])));
  }

  frustum(view, depth, color, width) {
    const c = this.corners(view, depth);
    const top = M.add(M.mix(c[0], c[1], 0.5), M.rotate(view.wxyz, [0, -0.25 * depth, 0]));
    const lines = c.flatMap((corner, i) => [[view.position, corner], [corner, c[(i + 1) % 4]]]);
    this.stroke(color, width, [...lines, [c[0], top], [top, c[1]]]);
  }

  frusta() {
    const { app } = this;
    const depth = app.frustumSize * app.camera.radius;
    const away = (camera) => M.length(M.sub(camera.view.position, app.camera.position));
    const near = app.cameras.map((camera, i) => [away(camera), camera, i]).sort((a, b) => b[0] - a[0]);
    near.forEach(([distance, camera, i], order) => {
      if (distance < 0.7 * depth) return; // one looks through it
      if (camera.photograph && order >= near.length - MOST_THUMBNAILS) this.thumbnail(camera.view, depth, i);
      const isUnderPointer = app.hovered === i;
      this.frustum(camera.view, depth, isUnderPointer ? "#ffffff" : "#5aa9ffb0", isUnderPointer ? 2 : 1);
    });
  }

  // The camera whose frustum is at a place of the picture, or -1.
  cameraAt(x, y) {
    if (!this.app.showsFrusta) return -1;
    const depth = this.app.frustumSize * this.app.camera.radius;
    let [best, found] = [14, -1];
    this.app.cameras.forEach((camera, i) => {
      const forward = M.rotate(camera.view.wxyz, [0, 0, depth]);
      const at = this.place(M.add(camera.view.position, forward));
      const distance = at ? Math.hypot(at[0] - x, at[1] - y) : Infinity;
      if (distance < best && this.seen(camera.view.position)[2] > 0.7 * depth) [best, found] = [distance, i];
    });
    return found;
  }

  thumbnail(view, depth, i) {
    if (!this.thumbnails.has(i)) {
      const image = new Image();
      image.src = `thumbnail/${i}`;
      image.onload = () => this.app.redraw();
      this.thumbnails.set(i, image);
    }
    const image = this.thumbnails.get(i);
    const quad = this.corners(view, depth).map((corner) => this.place(corner));
    if (!image.naturalWidth || quad.includes(null)) return;
    const { context } = this;
    const [w, h] = [image.naturalWidth, image.naturalHeight];
    // Two triangles, each by the affine map that takes three corners where they are.
    for (const [a, b, c, path] of [[0, 1, 3, [0, 1, 3]], [2, 3, 1, [1, 2, 3]]]) {
      const [o, u, v] = [quad[a], M.sub(quad[b], quad[a]), M.sub(quad[c], quad[a])];
      context.save();
      context.globalAlpha = 0.85;
      context.beginPath();
      path.forEach((corner, k) => (k ? context.lineTo(...quad[corner]) : context.moveTo(...quad[corner])));
      context.closePath();
      context.clip();
      const flip = a === 2 ? -1 : 1;
      const start = a === 2 ? [w, h] : [0, 0];
      context.transform((flip * u[0]) / w, (flip * u[1]) / w, (flip * v[0]) / h, (flip * v[1]) / h,
        o[0] - (flip * u[0] * start[0]) / w - (flip * v[0] * start[1]) / h,
        o[1] - (flip * u[1] * start[0]) / w - (flip * v[1] * start[1]) / h);
      context.drawImage(image, 0, 0);
      context.restore();
    }
  }

  compass() {
    const { arms: context } = this;
    context.clearRect(0, 0, 80, 80);
    const turned = M.inverse(this.app.camera.wxyz);
    const axes = ["x", "y", "z"].map((name, i) => [name, M.rotate(turned, AXES[name]), COLORS[i]]);
    context.font = "bold 12px system-ui";
    context.lineJoin = "round";
    context.textAlign = "center";
    context.textBaseline = "middle";
    for (const [name, [x, y], color] of axes.sort((a, b) => b[1][2] - a[1][2])) {
      context.beginPath();
      context.moveTo(40, 40);
      context.lineTo(40 + 20 * x, 40 + 20 * y);
      // A dark edge, to be seen on bright pictures, too.
      [context.strokeStyle, context.lineWidth] = ["#000c", 5];
      context.stroke();
      context.strokeText(name, 40 + 28 * x, 40 + 28 * y);
      [context.strokeStyle, context.lineWidth, context.fillStyle] = [color, 2, color];
      context.stroke();
      context.fillText(name, 40 + 28 * x, 40 + 28 * y);
    }
  }

  // Handles of the selected instance.

  get reach() {
    const depth = Math.max(this.seen(this.app.selected.pose.position)[2], 1e-6 * this.app.camera.radius);
    return (REACH * depth) / this.focal;
  }

  tip(i) {
    return M.add(this.app.selected.pose.position, M.mul(Object.values(AXES)[i], this.reach));
  }

  ring(i) {
    const { position } = this.app.selected.pose;
    const [u, v] = [Object.values(AXES)[(i + 1) % 3], Object.values(AXES)[(i + 2) % 3]];
    return RING.map((t) => M.add(position, M.add(M.mul(u, this.reach * Math.cos(t)), M.mul(v, this.reach * Math.sin(t)))));
  }

  selection() {
    const { app, context } = this;
    const { pose, box } = app.selected;
    const corner = (i) => [0, 1, 2].map((k) => box[(i >> k) & 1][k]);
    const world = (p) => M.add(pose.position, M.mul(M.rotate(pose.quaternion, p), pose.scale));
    const corners = [...Array(8).keys()].map((i) => world(corner(i)));
    const edges = [];
    for (let i = 0; i < 8; i++) for (const bit of [1, 2, 4]) if (!(i & bit)) edges.push([corners[i], corners[i | bit]]);
    this.stroke("#ffbe3c", 1.5, edges);
    const middle = this.place(pose.position);
    if (!middle) return;
    for (let i = 0; i < 3; i++) {
      const isHeld = app.held?.axis === i;
      if (app.tool === "turn") {
        const ring = this.ring(i);
        this.stroke(COLORS[i], isHeld ? 4 : 2.5, ring.slice(1).map((point, k) => [ring[k], point]));
      } else if (app.tool === "move") {
        this.stroke(COLORS[i], isHeld ? 5 : 3, [[pose.position, this.tip(i)]]);
        const tip = this.place(this.tip(i));
        if (tip) {
          context.fillStyle = COLORS[i];
          context.beginPath();
          context.arc(...tip, 6, 0, 7);
          context.fill();
        }
      }
    }
    context.fillStyle = "#ffbe3c";
    context.fillRect(middle[0] - 6, middle[1] - 6, 12, 12);
    if (app.tool === "size") {
      context.strokeStyle = "#ffbe3c";
      context.lineWidth = 3;
      context.beginPath();
      context.arc(...middle, REACH * 0.7, 0, 7);
      context.stroke();
    }
  }

  // The handle at a place of the picture: what dragging it changes, or null.
  handleAt(x, y, slack) {
    const { app } = this;
    if (!app.selected) return null;
    const middle = this.place(app.selected.pose.position);
    if (!middle) return null;
    const away = Math.hypot(x - middle[0], y - middle[1]);
    const start = { x, y, pose: structuredClone(app.selected.pose), middle };
    if (app.tool === "size") return Math.abs(away - REACH * 0.7) < slack || away < slack ? { ...start, kind: "size" } : null;
    let [best, axis] = [slack, -1];
    for (let i = 0; i < 3; i++) {
      const points = app.tool === "turn" ? this.ring(i) : [app.selected.pose.position, this.tip(i)];
      const places = points.map((point) => this.place(point));
      places.slice(1).forEach((b, k) => {
        const a = places[k];
        if (!a || !b) return;
        const along = M.sub(b, a);
        const t = M.clamp(M.dot(M.sub([x, y], a), along) / (M.dot(along, along) || 1), 0, 1);
        const distance = M.length(M.sub([x, y], M.add(a, M.mul(along, t))));
        if (distance < best) [best, axis] = [distance, i];
      });
    }
    if (app.tool === "move" && away < slack) return { ...start, kind: "slide" };
    return axis < 0 ? null : { ...start, kind: app.tool, axis };
  }

  // The pose that an instance has when its handle was taken to a place of the picture.
  dragged(held, x, y) {
    const { camera } = this.app;
    const pose = structuredClone(held.pose);
    const axis = held.axis >= 0 ? Object.values(AXES)[held.axis] : null;
    if (held.kind === "move") {
      const tip = this.place(M.add(held.pose.position, M.mul(axis, this.reach)));
      const along = M.sub(tip ?? held.middle, held.middle);
      const t = M.dot([x - held.x, y - held.y], along) / Math.max(M.dot(along, along), 25);
      pose.position = M.add(pose.position, M.mul(axis, t * this.reach));
    } else if (held.kind === "slide") {
      const step = this.seen(held.pose.position)[2] / this.focal;
      const moved = M.add(M.mul(camera.right, (x - held.x) * step), M.mul(camera.down, (y - held.y) * step));
      pose.position = M.add(pose.position, moved);
    } else if (held.kind === "turn") {
      const angle = (px, py) => Math.atan2(py - held.middle[1], px - held.middle[0]);
      const facing = M.dot(axis, camera.forward) < 0 ? -1 : 1;
      const turned = facing * (angle(x, y) - angle(held.x, held.y));
      pose.quaternion = M.unit(M.product(M.about(axis, turned), pose.quaternion));
    } else {
      const away = (px, py) => Math.max(Math.hypot(px - held.middle[0], py - held.middle[1]), 5);
      pose.scale = M.clamp(pose.scale * (away(x, y) / away(held.x, held.y)), 1e-6, 1e6);
    }
    return pose;
  }
}
