"""Whether a fade between levels removes pops, and what an eye makes of it.

`measure` flies bundles along slow paths, `scenes` looks at scenes in windows, and
`video` asks ColorVideoVDP.
"""
