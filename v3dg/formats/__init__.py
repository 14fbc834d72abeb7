"""Files of other programs: a module a format, with `read` and, where it is written,
`write`."""
