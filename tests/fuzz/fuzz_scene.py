#!/usr/bin/env python3
"""Coverage-guided fuzzer of the scene and camera files, for atheris (run.py starts it)."""

import random
import sys
import tempfile
import warnings
from pathlib import Path

import atheris

sys.path.insert(0, str(Path(__file__).parent.parent))
sys.path.insert(0, str(Path(__file__).parent.parent / "support"))

with atheris.instrument_imports(include=["v3dg"]):
    from fuzz.targets import read_json

from fuzz.mutations import changed_json

FOLDER = Path(tempfile.mkdtemp())


def mutate(data, max_size, seed):
    rng = random.Random(seed)
    if rng.random() < 0.3:
        return atheris.Mutate(data, max_size)
    for _ in range(rng.randrange(1, 4)):
        data = changed_json(data, rng)
    return data[:max_size]


if __name__ == "__main__":
    warnings.simplefilter("error")  # an overflow, say
    atheris.Setup(sys.argv, lambda content: read_json(content, FOLDER), custom_mutator=mutate)
    atheris.Fuzz()
