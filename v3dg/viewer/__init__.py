"""The viewer of `v3dg view`: a web server whose pictures the renderer draws. Needs the
extra `viewer`.

`view` says from where a tab looks, `frame` draws what it shows, `pacing` decides how
large and when, and `path` flies the camera: these know no browser. `messages` and
`answers` are what a page and the viewer say to each other, a `tab` is the server's half
of a page, `exports` does its long work, `gate` decides who may connect, and `server`
serves the page in `page/` and gives each browser that connects a tab.
"""
