"""Our frames and gradients in comparison with those of other rasterizers, in one run.

`measure` records the measurements, `scenes` and `draw` define the scenes and renderers,
and `report` makes a page of one or more results.
"""
