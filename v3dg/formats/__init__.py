"""Readers and writers for the files of other programs, one module per format.

Each module has `open_file(path)`, which returns an `AssetFile` (`_reading.py`). If the
format can be written, it also has `write(path, gaussians)`. The end of a file's name
selects the module (`v3dg.io`). docs/extending.md describes how to add a format.
"""
