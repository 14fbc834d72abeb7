"""The command `python -m benchmarks.studies.mass`, which runs measure.py."""

import tyro

from benchmarks.studies.mass.measure import Config, main

if __name__ == "__main__":
    main(tyro.cli(Config))
