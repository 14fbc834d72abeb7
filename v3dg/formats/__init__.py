"""Readers and writers for the files of other programs, one module per format.

Each module has `open_file(path)`, which returns an `AssetFile` (`_reading.py`), and, if
the format can be written, `write(path, gaussians)`. `v3dg.io` chooses the module by the
end of the file's name. docs/extending.md describes how to add a format.
"""
