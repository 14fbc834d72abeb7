"""How tests start Chromium, for pages that draw with WebGL."""

import shutil

PROGRAM = shutil.which("chromium") or shutil.which("google-chrome")

# WebGL in software, and nothing that asks the network.
ARGUMENTS = [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
