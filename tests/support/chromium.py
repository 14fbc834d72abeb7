"""Starts Chromium in tests, for pages that draw with WebGL."""

import shutil

PROGRAM = shutil.which("chromium") or shutil.which("google-chrome")

# These arguments make Chromium draw WebGL in software, and prevent requests to the
# network.
ARGUMENTS = [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
