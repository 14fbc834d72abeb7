"""`python -m benchmarks.studies.mass`; measure.py says what it does."""

import tyro

from benchmarks.studies.mass.measure import Config, main

if __name__ == "__main__":
    main(tyro.cli(Config))
