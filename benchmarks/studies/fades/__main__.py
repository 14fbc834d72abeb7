"""The command `python -m benchmarks.studies.fades`, which runs measure.py."""

import sys

from benchmarks.studies.fades.measure import main

if __name__ == "__main__":
    sys.exit(main())
