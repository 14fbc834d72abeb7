"""Runs each attack of fuzz/attack.py for a short time. That program itself runs for any
length of time."""

import json

import pytest

from fuzz.attacks.pool import attack

# All attacks together take about a minute on two cores. Their seeds differ from those
# at which long runs begin.
TRIES = {
    "files": 500,
    "commands": 24,
    "misuses": 300,
    "interrupts": 14,
    "kills": 8,
    "bounded": 6,
    "threads": 30,
    "settling": 6,
    "memory": 8,
    "exports": 40,
    "servers": 12,
    "ends": 12,
    "headers": 60,
    "extreme_numbers": 40,
}


@pytest.mark.parametrize("kind", TRIES)
def test_nothing_is_found(kind, tmp_path):
    if kind == "servers":
        pytest.importorskip("aiohttp")
    found = attack(kind, range(TRIES[kind]), seconds=300, seed=2026, kept=tmp_path)
    assert found["tries"] == TRIES[kind]
    assert not found["findings"], json.dumps(found["findings"], indent=1)
