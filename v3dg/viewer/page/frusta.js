// Draws frusta: those of the file's cameras with their photographs, and the frustum of
// a frozen cut.

import * as M from "./math.js";

/** @typedef {import("./app.js").App} App */
/** @typedef {import("./page.js").Place} Place */
/** @typedef {import("./page.js").Vector} Vector */
/** @typedef {import("./projection.js").Line} Line */
/** @typedef {import("./projection.js").Projection} Projection */
/** @typedef {import("./protocol.js").View} View */

const FROZEN_COLOR = "#ffbe3c";
const CAMERA_COLOR = "#5aa9ffb0";
const HOVERED_COLOR = "#ffffff";
/** Depth of the frustum of a frozen cut, in radii of the scene. */
const FROZEN_DEPTH = 0.08;
const MOST_THUMBNAILS = 40;
const THUMBNAIL_OPACITY = 0.85;
/**
 * Cameras closer than this number of frustum depths are not drawn, because the user is
 * looking through them.
 */
const NEAREST_DEPTHS = 0.7;
/** Largest distance of the pointer from the middle of a frustum, px. */
const HOVER_PX = 14;

export class Frusta {
  /**
   * Thumbnails of the photographs, by the index of the camera.
   *
   * @type {Map<number, HTMLImageElement>}
   */
  thumbnails = new Map();

  /**
   * @param {App} app
   * @param {Projection} projection
   */
  constructor(app, projection) {
    this.app = app;
    this.projection = projection;
  }

  /** Depth of the frusta of cameras, world units. */
  get depth() {
    return this.app.fileCameras.frustumSize * this.app.camera.radius;
  }

  /**
   * Draws the frustum of a frozen cut.
   *
   * @param {View} view The view for which the cut was selected.
   */
  drawFrozen(view) {
    this.drawFrustum(view, FROZEN_DEPTH * this.app.camera.radius, FROZEN_COLOR, 2);
  }

  /** Draws the frusta of all cameras, farthest first. */
  draw() {
    const { camera, fileCameras } = this.app;
    const { depth } = this;
    const order = fileCameras.list.map(({ view, photograph }, index) => {
      const distance = M.length(M.sub(view.position, camera.position));
      return { view, photograph, index, distance };
    });
    order.sort((a, b) => b.distance - a.distance);
    const firstThumbnail = order.length - MOST_THUMBNAILS;
    order.forEach(({ view, photograph, index, distance }, i) => {
      if (distance < NEAREST_DEPTHS * depth) return;
      if (photograph && i >= firstThumbnail) this.drawThumbnail(view, depth, index);
      if (index === fileCameras.hovered) this.drawFrustum(view, depth, HOVERED_COLOR, 2);
      else this.drawFrustum(view, depth, CAMERA_COLOR, 1);
    });
  }

  /**
   * Returns the corners of a frustum's far side in order, beginning with the upper left
   * one.
   *
   * @param {View} view
   * @param {number} depth
   */
  corners(view, depth) {
    const y = depth * Math.tan(view.fov_y / 2);
    const x = y * view.aspect;
    /** @type {Vector[]} */
    const corners = [
      [-x, -y, depth],
      [x, -y, depth],
      [x, y, depth],
      [-x, y, depth],
    ];
    return corners.map((corner) => M.add(view.position, M.rotate(view.wxyz, corner)));
  }

  /**
   * Draws the edges of a frustum.
   *
   * @param {View} view
   * @param {number} depth
   * @param {string} color
   * @param {number} width The width of the lines, px.
   */
  drawFrustum(view, depth, color, width) {
    const corners = this.corners(view, depth);
    const [left, right] = corners;
    const up = M.rotate(view.wxyz, [0, -0.25 * depth, 0]);
    const top = M.add(M.mix(left, right, 0.5), up);
    /** @type {Line[]} */
    const lines = [
      [left, top],
      [top, right],
    ];
    corners.forEach((corner, i) => {
      lines.push([view.position, corner]);
      lines.push([corner, corners[(i + 1) % 4]]);
    });
    this.projection.stroke(color, width, lines);
  }

  /**
   * Returns the index of the camera whose frustum is at a position in the picture, or
   * -1.
   *
   * @param {number} x
   * @param {number} y
   */
  cameraAt(x, y) {
    const { fileCameras } = this.app;
    const { depth, projection } = this;
    let nearest = HOVER_PX;
    let result = -1;
    if (!fileCameras.showsFrusta) return result;
    fileCameras.list.forEach(({ view }, index) => {
      const middle = M.add(view.position, M.rotate(view.wxyz, [0, 0, depth]));
      const place = projection.place(middle);
      if (!place || projection.inCamera(view.position)[2] <= NEAREST_DEPTHS * depth) return;
      const distance = Math.hypot(place[0] - x, place[1] - y);
      if (distance < nearest) {
        nearest = distance;
        result = index;
      }
    });
    return result;
  }

  /**
   * Draws the photograph of a camera on the far side of its frustum.
   *
   * @param {View} view
   * @param {number} depth
   * @param {number} index
   */
  drawThumbnail(view, depth, index) {
    const image = this.thumbnail(index);
    const places = this.corners(view, depth).map((corner) => this.projection.place(corner));
    if (!image.naturalWidth || places.includes(null)) return;
    const [upperLeft, upperRight, lowerRight, lowerLeft] = places;
    const { naturalWidth, naturalHeight } = image;
    // The photograph is drawn as two triangles. Each uses the affine map that is exact
    // at its three corners.
    this.drawHalf(image, [0, 0], 1, [upperLeft, upperRight, lowerLeft]);
    this.drawHalf(image, [naturalWidth, naturalHeight], -1, [lowerRight, lowerLeft, upperRight]);
  }

  /**
   * Draws the half of an image that is inside a triangle.
   *
   * @param {HTMLImageElement} image
   * @param {Place} origin The corner of the image at the right angle of the triangle,
   *   px.
   * @param {1 | -1} sign The sign of the directions in which the image's sides extend
   *   from that corner.
   * @param {Place[]} triangle The corner with the right angle, the end of the
   *   horizontal side, and the end of the vertical side.
   */
  drawHalf(image, origin, sign, [corner, sideways, downwards]) {
    const { context } = this.projection;
    const across = M.mul(M.sub(sideways, corner), sign / image.naturalWidth);
    const along = M.mul(M.sub(downwards, corner), sign / image.naturalHeight);
    const x = corner[0] - across[0] * origin[0] - along[0] * origin[1];
    const y = corner[1] - across[1] * origin[0] - along[1] * origin[1];
    context.save();
    context.globalAlpha = THUMBNAIL_OPACITY;
    context.beginPath();
    context.moveTo(...corner);
    context.lineTo(...sideways);
    context.lineTo(...downwards);
    context.closePath();
    context.clip();
    context.transform(across[0], across[1], along[0], along[1], x, y);
    context.drawImage(image, 0, 0);
    context.restore();
  }

  /**
   * Returns the small photograph of a camera. It is loaded when it is first needed.
   *
   * @param {number} index
   */
  thumbnail(index) {
    const loaded = this.thumbnails.get(index);
    if (loaded) return loaded;
    const image = new Image();
    image.src = `thumbnail/${index}`;
    image.addEventListener("load", () => this.app.redraw());
    this.thumbnails.set(index, image);
    return image;
  }
}
