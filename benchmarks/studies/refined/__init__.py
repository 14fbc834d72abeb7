"""Errors of cuts before and after a refinement of the levels.

`measure` uses single assets, `worlds` uses composed scenes, and `steps` compares ways
to refine.
"""
