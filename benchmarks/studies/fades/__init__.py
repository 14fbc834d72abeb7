"""Studies of whether a fade between levels removes visible pops.

`measure` moves along slow paths past bundles. `scenes` measures windows of scenes.
`video` uses ColorVideoVDP.
"""
