"""The viewer of `v3dg view`: a web page drawn by the renderer. Wants the extra `viewer`.

`view` says from where a page looks, `frame` draws what it shows, `pacing` decides how large and when, `path`
flies the camera, and `page` is the page itself; all but the last work without a browser.
"""
