"""`python -m benchmarks.studies.peers`; measure.py says what it does."""

import tyro

from benchmarks.studies.peers.measure import Config, main

if __name__ == "__main__":
    main(tyro.cli(Config))
