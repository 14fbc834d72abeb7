// Starts the viewer's web page.

import { App } from "./app.js";

/** The app is public for tests, and for programs that take screenshots. */
window.viewer = new App();
