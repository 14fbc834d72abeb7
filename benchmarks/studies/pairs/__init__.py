"""Levels at equal counts and several sizes, in comparison with those of other tools.

`measure` records errors of assets (`subject`), `report` makes a page from them.
"""
