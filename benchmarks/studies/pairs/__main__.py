"""`python -m benchmarks.studies.pairs`; measure.py says what it does."""

from benchmarks.studies.pairs.measure import main

if __name__ == "__main__":
    main()
