#!/usr/bin/env python3
"""Coverage-guided fuzzer of the formats that other programs write, for atheris (run.py starts it)."""

import random
import sys
import tempfile
import warnings
from pathlib import Path

import atheris

sys.path.insert(0, str(Path(__file__).parent.parent))
sys.path.insert(0, str(Path(__file__).parent.parent / "support"))

with atheris.instrument_imports(include=["v3dg"]):
    from fuzz.targets import FORMATS, META_IN_SOG, read_format

from fuzz.mutations import changed_json

FOLDER = Path(tempfile.mkdtemp())


def mutate(data, max_size, seed):
    rng = random.Random(seed)
    if data[:1] and data[0] % len(FORMATS) == META_IN_SOG and rng.random() < 0.8:
        return (data[:1] + changed_json(data[1:], rng))[:max_size]
    return atheris.Mutate(data, max_size)


if __name__ == "__main__":
    warnings.simplefilter("error")  # an overflow, say
    atheris.Setup(sys.argv, lambda content: read_format(content, FOLDER), custom_mutator=mutate)
    atheris.Fuzz()
