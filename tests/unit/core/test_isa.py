"""Tests the instruction sets for which the CPU code is compiled."""

import os
import subprocess
import sys

import pytest

from v3dg import _core

ISAS = ["baseline", "avx2", "avx512"]


def run_with_isa(isa: str) -> subprocess.CompletedProcess[str]:
    code = "from v3dg import _core; print(_core.isa())"
    # The child process gets the parent's search path, so that both use the same v3dg.
    environment = {
        **os.environ,
        "V3DG_ISA": isa,
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
    }
    return subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True
    )


def test_default_is_a_known_isa():
    assert _core.isa() in ISAS


@pytest.mark.parametrize("isa", ISAS)
def test_environment_chooses_the_isa_or_says_why_not(isa):
    widest = run_with_isa("").stdout.strip()
    result = run_with_isa(isa)
    if ISAS.index(isa) <= ISAS.index(widest):
        assert result.stdout.strip() == isa, result.stderr
    else:
        assert result.returncode != 0
        assert (
            f"V3DG_ISA: this processor does not support {isa}; use at most {widest}"
            in result.stderr
        )


@pytest.mark.parametrize("wrong", ["sse9", "AVX2", "avx"])
def test_wrong_isa_is_refused_by_name(wrong):
    result = run_with_isa(wrong)
    assert result.returncode != 0
    assert f"V3DG_ISA: expected baseline, avx2 or avx512, got {wrong}" in result.stderr
