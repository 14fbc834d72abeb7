"""BLAKE2b in C++ computes the same bits as Python's, for one message and for several,
with every instruction set."""

import hashlib
import os
import subprocess
import sys

import numpy as np
import pytest

from test_isa import ISAS
from v3dg import _core

LENGTHS = [*range(301), 1023, 1024, 4095, 4096, 4097, 70_001]


def messages_of(lengths):
    data = np.random.default_rng(len(lengths)).integers(
        0, 256, max(lengths, default=0) + 64, np.uint8
    )
    # Most of these messages are not aligned in memory.
    return [data[k % 64 : k % 64 + length] for k, length in enumerate(lengths)]


def check(messages):
    expected = [hashlib.blake2b(message.tobytes(), digest_size=16).digest() for message in messages]
    assert _core.blake2b(messages) == expected


def check_all():
    rng = np.random.default_rng(0)
    for length in LENGTHS:
        for count in (1, 8):
            check(messages_of([length] * count))
    for count in range(20):
        check(messages_of([4096] * count))
        check(messages_of(rng.choice(LENGTHS, count).tolist()))
    check(messages_of(LENGTHS))
    check(messages_of([0, 128, 256, 0, 1, 129, 70_001, 127]))
    check(messages_of([70_001, *[0] * 30]))


def test_digests_are_those_of_python():
    check_all()


@pytest.mark.parametrize("isa", ISAS[: ISAS.index(_core.isa())])
def test_narrower_instruction_sets_give_the_same_digests(isa):
    code = (
        f"import test_blake2b; assert test_blake2b._core.isa() == {isa!r}; test_blake2b.check_all()"
    )
    environment = {
        **os.environ,
        "V3DG_ISA": isa,
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
    }
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def test_only_bytes_are_hashed():
    with pytest.raises(ValueError, match="messages: expected"):
        _core.blake2b([np.zeros(3, np.float32)])
    with pytest.raises(TypeError):
        _core.blake2b([b"abc"])
