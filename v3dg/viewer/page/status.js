// Messages of the web page: the line below the picture, and notices above it.

import { element, make } from "./elements.js";

/** @typedef {"connecting" | "moving" | "refining" | "ready" | "failed"} State */

const NOTICE_MS = 7000;

export class Status {
  /** @type {HTMLElement} */
  refinedBar = element("refined").querySelector("div");

  /**
   * Shows the state of the connection or of the picture.
   *
   * @param {State} state
   * @param {string} text
   */
  say(state, text) {
    document.body.dataset.state = state;
    element("status").textContent = text;
  }

  /**
   * Shows how far the picture is refined.
   *
   * @param {number} share The width of the picture as a fraction of the full width.
   */
  showRefined(share) {
    this.refinedBar.style.width = `${100 * share}%`;
  }

  /**
   * Shows a warning.
   *
   * @param {string} text A description of the problem.
   */
  warn(text) {
    this.addNotice(text, "");
  }

  /**
   * Confirms an action.
   *
   * @param {string} text A description of the action.
   */
  confirm(text) {
    this.addNotice(text, "good");
  }

  /**
   * Shows a notice for some time.
   *
   * @param {string} text
   * @param {string} className
   */
  addNotice(text, className) {
    const line = make("p", { className }, text);
    element("notices").append(line);
    setTimeout(() => line.remove(), NOTICE_MS);
  }
}
