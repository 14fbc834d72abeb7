"""Cuts of levels before and after refinement.

`measure` uses single assets, `worlds` composed scenes; `steps` compares ways to refine,
and `qualities` the qualities of a build.
"""
