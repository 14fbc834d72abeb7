"""The command `python -m benchmarks.studies.residency`, which runs measure.py."""

import tyro

from benchmarks.studies.residency.measure import Config, main

if __name__ == "__main__":
    main(tyro.cli(Config))
