"""Stand-ins for functions of other packages, with their arguments and results."""
