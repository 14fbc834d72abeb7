// The statistics of the last picture in the panel, and the legend of its colours.

import { shortText, tableOf } from "./controls.js";
import { make } from "./elements.js";

/** @typedef {import("./protocol.js").Picture} Picture */
/** @typedef {import("./protocol.js").Scene} Scene */

/**
 * Returns the statistics of a picture as elements.
 *
 * @param {Picture} picture
 * @param {Scene} scene
 * @returns {HTMLElement[]}
 */
export function figuresOf(picture, scene) {
  const { levels } = picture.figures;
  return [tableOf(rowsOf(picture)), ...legendOf(picture, scene), ...histogramOf(levels, scene)];
}

/**
 * Returns the rows of the table of statistics.
 *
 * @param {Picture} picture
 */
function rowsOf({ figures, size }) {
  const mebibytes = Math.round(figures.memory_bytes / 2 ** 20);
  const rows = [
    ["selected", grouped(figures.gaussians_selected)],
    ["in the frustum", grouped(figures.gaussians_in_frustum)],
    ["tolerance", `${shortText(figures.tolerance)} px²`],
    ["select", `${figures.select_ms.toFixed(1)} ms`],
    ["draw", `${figures.draw_ms.toFixed(1)} ms`],
    ["picture", `${size[0]} x ${size[1]}`],
  ];
  if (figures.missing) rows.push(["missing pages", grouped(figures.missing)]);
  rows.push(["memory", `${grouped(mebibytes)} MiB`]);
  return rows;
}

/**
 * Returns the legend of a picture's colours.
 *
 * @param {Picture} picture
 * @param {Scene} scene
 * @returns {HTMLElement[]}
 */
function legendOf({ shows, range }, scene) {
  if (shows === "residency") {
    const [none, ...missing] = scene.missing_colors.map(cssColor);
    const colors = [`${none} 25%`, `${missing[0]} 25%`, ...missing.slice(1)];
    return barOf(colors, ["nothing missing", "finer pages missing"]);
  }
  if (!range) return [];
  const [low, high] = range.map(shortText);
  const colors = scene.ramp.map(cssColor);
  switch (shows) {
    case "alpha":
      return barOf(["#000", "#fff"], [low, high]);
    case "count":
      return barOf(colors, ["1", "4", "16", "64", `${scene.most_counted}+`]);
    case "error":
      return barOf(colors, ["finest", `tolerance, ${high} px²`]);
    case "depth":
      return barOf(colors, [`far ${low}`, `near ${high}`]);
    default:
      return barOf(colors, [low, high]);
  }
}

/**
 * Returns a colour gradient with labels.
 *
 * @param {string[]} colors The colours of the gradient, from left to right.
 * @param {string[]} marks The labels below the gradient.
 */
function barOf(colors, marks) {
  const ramp = make("div", { className: "ramp" });
  ramp.style.background = `linear-gradient(90deg, ${colors.join(",")})`;
  return [ramp, marksOf(marks)];
}

/**
 * Shows the number of selected gaussians of each level as bars.
 *
 * @param {number[]} levels
 * @param {Scene} scene
 */
function histogramOf(levels, scene) {
  if (levels.length < 2) return [];
  const most = Math.max(...levels, 1);
  const bars = levels.map((count, level) => {
    const bar = make("div", { title: `level ${level}: ${grouped(count)}` });
    bar.style.height = `${Math.max((100 * count) / most, 1)}%`;
    bar.style.background = cssColor(scene.level_colors[level]);
    return bar;
  });
  const marks = marksOf(["level 0", "selected by level", String(levels.length - 1)]);
  return [make("div", { className: "levels" }, ...bars), marks];
}

/**
 * Returns labels in a row.
 *
 * @param {string[]} marks
 */
function marksOf(marks) {
  return make("div", { className: "marks" }, ...marks.map((mark) => make("span", {}, mark)));
}

/**
 * Returns a colour as text for CSS.
 *
 * @param {number[]} color
 */
function cssColor(color) {
  return `rgb(${color})`;
}

/**
 * Returns an integer as text with groups of three digits.
 *
 * @param {number} count
 */
export function grouped(count) {
  return count.toLocaleString("en");
}
