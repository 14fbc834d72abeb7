// Starts the viewer's page.

import { App } from "./app.js";

/** For tests and programs that take pictures of the page. */
window.viewer = new App();
