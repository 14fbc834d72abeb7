"""The viewer of `v3dg view`: a web server that sends pictures of the renderer to
browsers. Needs the extra `viewer`.

These modules know nothing about browsers: `view` has the viewpoint of a tab, `frame`
draws the pictures of a tab, `pacing` decides the size and the time of pictures, and
`path` moves the camera along a path. `messages` and `answers` define the protocol
between a web page and the viewer. `tab` is the server's part of a connected web page,
`exports` does the long work of a tab, and `gate` decides who may connect. `server`
serves the web page in `page/`, and creates a tab for each browser that connects.
"""
