"""Errors of cuts before and after a refinement of the levels.

`measure` uses single assets, `worlds` uses composed scenes, `steps` compares ways to
refine, and `qualities` compares the qualities of a build.
"""
