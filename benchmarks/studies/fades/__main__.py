"""`python -m benchmarks.studies.fades`; measure.py says what it does."""

import sys

from benchmarks.studies.fades.measure import main

if __name__ == "__main__":
    sys.exit(main())
