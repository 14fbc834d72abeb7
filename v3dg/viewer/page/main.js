// Starts the viewer's page.

import { App } from "./app.js";

/** Public for tests and for programs that take screenshots of the page. */
window.viewer = new App();
