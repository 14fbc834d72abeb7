"""The command `python -m benchmarks.studies.refined`, which runs measure.py."""

import tyro

from benchmarks.studies.refined.measure import Config, main

if __name__ == "__main__":
    main(tyro.cli(Config))
