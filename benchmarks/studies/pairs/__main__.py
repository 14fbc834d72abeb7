"""The command `python -m benchmarks.studies.pairs`."""

from benchmarks.studies.pairs.measure import main

if __name__ == "__main__":
    main()
