"""Frames and gradients of v3dg in comparison with other rasterizers, in one run.

`measure` records the measurements, `scenes` and `draw` define the scenes and renderers,
and `report` makes a page from one or more results.
"""
