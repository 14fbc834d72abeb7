"""Levels at equal counts and several sizes, beside those of other tools.

`measure` records errors of assets (`subject`), `report` makes the page of them.
"""
