"""Whether a fade between levels removes visible pops.

`measure` moves along slow paths past bundles, `scenes` measures windows of scenes, and
`video` uses ColorVideoVDP.
"""
