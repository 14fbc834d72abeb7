"""`python -m benchmarks.studies.refined`; measure.py says what it does."""

import tyro

from benchmarks.studies.refined.measure import Config, main

if __name__ == "__main__":
    main(tyro.cli(Config))
