"""Cuts of levels as they are built, and refined together.

`measure` is of single assets, `worlds` of composed scenes.
"""
