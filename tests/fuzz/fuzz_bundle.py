#!/usr/bin/env python3
"""Coverage-guided fuzzer of the bundle reader, for atheris (run.py starts it)."""

import random
import struct
import sys
import tempfile
import warnings
from pathlib import Path

import atheris

sys.path.insert(0, str(Path(__file__).parent.parent))
sys.path.insert(0, str(Path(__file__).parent.parent / "support"))

with atheris.instrument_imports(include=["v3dg"]):
    from fuzz.targets import parts_of, read_bundle

from fuzz.mutations import changed_json

FOLDER = Path(tempfile.mkdtemp())
INTEGERS = (0, 1, 2, 3, -1, 4096, 1 << 30, (1 << 31) - 1, -(1 << 31))
FLOATS = (0.0, -0.0, 1.0, -1.0, 1e-38, 1e-45, 1e38, float("inf"), float("-inf"), float("nan"))


def mutate(data, max_size, seed):
    """Change bytes, the header as a document, or numbers in the tables."""
    rng = random.Random(seed)
    parts = parts_of(data)
    action = rng.random()
    if parts is None or action < 0.2:
        return atheris.Mutate(data, max_size)
    _, start, pages_end, hash_end = parts
    if action < 0.5:
        text = changed_json(data[8:start], rng)
        text += b" " * (-(8 + len(text)) % 4096)
        return (len(text).to_bytes(8, "little") + text + data[start:])[:max_size]
    data = bytearray(data)
    first, last = start + pages_end, start + hash_end - 20
    for _ in range(rng.randrange(1, 4) if first < last else 0):
        kind, values = rng.choice((("<i", INTEGERS), ("<f", FLOATS)))
        struct.pack_into(kind, data, rng.randrange(first, last) // 4 * 4, rng.choice(values))
    return bytes(data[:max_size])


if __name__ == "__main__":
    warnings.simplefilter("error")  # an overflow, say
    atheris.Setup(sys.argv, lambda content: read_bundle(content, FOLDER), custom_mutator=mutate)
    atheris.Fuzz()
