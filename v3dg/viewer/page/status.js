// What the page says of itself: the line below the picture, and notices above it.

import { element, make } from "./elements.js";

/** @typedef {"connecting" | "moving" | "refining" | "ready" | "failed"} State */

const NOTICE_MS = 7000;

export class Status {
  /** @type {HTMLElement} */
  refinedBar = element("refined").querySelector("div");

  /**
   * @param {State} state
   * @param {string} text
   */
  say(state, text) {
    document.body.dataset.state = state;
    element("status").textContent = text;
  }

  /** @param {number} share Width of the picture, as a share of that of the full one. */
  showRefined(share) {
    this.refinedBar.style.width = `${100 * share}%`;
  }

  /** @param {string} text What went wrong. */
  warn(text) {
    this.addNotice(text, "");
  }

  /** @param {string} text What was done. */
  confirm(text) {
    this.addNotice(text, "good");
  }

  /**
   * @param {string} text
   * @param {string} className
   */
  addNotice(text, className) {
    const line = make("p", { className }, text);
    element("notices").append(line);
    setTimeout(() => line.remove(), NOTICE_MS);
  }
}
