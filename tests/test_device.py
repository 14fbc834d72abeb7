"""Devices: the tests' helpers bring arrays there, and asking for CUDA where it is missing is an error."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import devices
import scenes
import v3dg
from v3dg import _core, _device

BUILT_WITHOUT = "v3dg was built without CUDA; install it again where nvcc is found"
NO_DEVICE = "expected a CUDA device and its driver, found none"


def test_arrays_go_to_a_device_and_back(device):
    asset = scenes.gaussians([[0, 0, 1], [1, 2, 3]])
    there = devices.on(device, asset)
    assert ("cuda" in repr(there)) == (device == "cuda")
    back = devices.host(there)
    for name in scenes.NAMES:
        np.testing.assert_array_equal(getattr(back, name), getattr(asset, name))


def test_unknown_device_is_named():
    with pytest.raises(ValueError, match="device: expected 'auto', 'cpu' or 'cuda', got 'gpu'"):
        _device.resolve("gpu")


def test_auto_is_the_cpu_where_cuda_is_missing(monkeypatch):
    assert _device.resolve("cpu") == "cpu"
    monkeypatch.setattr(_device, "missing_for_cuda", lambda: "something")
    assert _device.resolve("auto") == "cpu"
    with pytest.raises(RuntimeError, match="device: something; or use 'cpu'"):
        _device.resolve("cuda")


@pytest.mark.gpu
def test_auto_is_cuda_where_nothing_is_missing():
    assert _device.resolve("auto") == _device.resolve("cuda") == "cuda"


@pytest.mark.skipif(_core.num_cuda_devices() > 0, reason="there is a CUDA device")
def test_missing_device_is_named():
    expected = NO_DEVICE if _core.has_cuda else BUILT_WITHOUT
    with pytest.raises(RuntimeError, match=f"device: {expected}; or use 'cpu'"):
        _device.resolve("cuda")


# What `import torch` fails with where there is none, and a core that has a device.
NO_TORCH_SCRIPT = """
import sys
sys.modules["torch"] = None
from v3dg import _core, _device
_core.has_cuda, _core.num_cuda_devices = True, lambda: 1
print(_device.resolve("auto"))
_device.resolve("cuda")
"""


def test_missing_torch_is_named(tmp_path):
    environment = os.environ | {"PYTHONPATH": str(Path(v3dg.__file__).parent.parent)}
    command = [sys.executable, "-c", NO_TORCH_SCRIPT]
    run = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert run.stdout == "cpu\n"
    assert run.stderr.splitlines()[-1] == (
        "RuntimeError: device: expected torch, which owns arrays on CUDA devices; "
        "pip install 'v3dg[torch]'; or use 'cpu'"
    )
