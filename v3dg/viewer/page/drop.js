// Sends files that are dropped onto the web page to the viewer, which then shows them.

import { element } from "./elements.js";

/** @typedef {import("./app.js").App} App */

/**
 * Accepts files that are dropped onto the web page.
 *
 * @param {App} app
 */
export function acceptDrops(app) {
  const sign = element("drop");
  window.addEventListener("dragover", (event) => {
    event.preventDefault();
    sign.hidden = false;
  });
  window.addEventListener("dragleave", (event) => {
    if (event.relatedTarget === null) sign.hidden = true;
  });
  window.addEventListener("drop", async (event) => {
    event.preventDefault();
    sign.hidden = true;
    const [file] = event.dataTransfer.files;
    if (file) await send(app, file);
  });
}

/**
 * Sends a file to the viewer, and shows the progress.
 *
 * @param {App} app
 * @param {File} file
 */
async function send(app, file) {
  app.status.say("refining", `sending ${file.name}`);
  await app.connection.sendFile(file, (share) => {
    app.status.say("refining", `sending ${file.name}, ${Math.round(100 * share)} %`);
  });
}
