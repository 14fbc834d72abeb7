"""Errors of levels at equal numbers of gaussians and at several picture sizes, in
comparison with levels of other tools.

`measure` records the errors for assets, which `subject` defines. `report` makes a page
from the records.
"""
