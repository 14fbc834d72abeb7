"""The viewer of `v3dg view`: a web server whose pictures the renderer draws. Needs the
extra `viewer`.

`view` has the viewpoint of a tab, `frame` draws what the tab shows, `pacing` decides
the size and the time of pictures, and `path` moves the camera along a path; these
modules know no browser. `messages` and `answers` define the protocol between a page and
the viewer. A `tab` is the server's half of a page, `exports` does its long work, `gate`
decides who may connect, and `server` serves the page in `page/` and makes a tab for
each browser that connects.
"""
