"""Our frames and gradients beside those of other rasterizers, in one run.

`measure` records what everyone takes, `scenes` and `draw` say of what and how, and
`report` makes the page of one or more results.
"""
