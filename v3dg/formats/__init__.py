"""Files of other programs: one module per format. Its contract is `open_file(path)`,
which returns an `AssetFile` (`_reading.py`), and, for a format that is written,
`write(path, gaussians)`. `v3dg.io` lists the functions by the end of the file's
name. docs/extending.md says how to add one."""
