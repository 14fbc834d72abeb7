"""`python -m benchmarks.studies.residency`; measure.py says what it does."""

import tyro

from benchmarks.studies.residency.measure import Config, main

if __name__ == "__main__":
    main(tyro.cli(Config))
