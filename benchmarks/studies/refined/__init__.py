"""Cuts of levels before and after refinement.

`measure` uses single assets, `worlds` composed scenes.
"""
