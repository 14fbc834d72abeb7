"""The command `python -m benchmarks.studies.peers`, which runs measure.py."""

import tyro

from benchmarks.studies.peers.measure import Config, main

if __name__ == "__main__":
    main(tyro.cli(Config))
