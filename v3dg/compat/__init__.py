"""Replacements for functions of other packages, with the same arguments and results as
the originals."""
