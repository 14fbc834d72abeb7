"""The viewer of `v3dg view`: a web server whose pictures the renderer draws. Needs the
extra `viewer`.

`view` says from where a tab looks, `frame` draws what it shows, `pacing` decides how
large and when, `path` flies the camera: these know no browser. `figures`, `controls`,
`exports` and `path_controls` are the parts of a browser's `tab`, and `server` gives
each browser that connects one.
"""
