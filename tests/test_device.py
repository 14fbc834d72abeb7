"""Devices: the tests' helpers bring arrays there, and asking for CUDA where it is missing is an error."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import devices
import scenes
import v3dg
from v3dg import _core, _device, _operations

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
from v3dg import _core, _device, _operations
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


# ---- arguments of the core


class OnDevice:
    """What the core sees of an array on a device, without a device: enough to be refused."""

    def __init__(self, shape, typestr="<f4", strides=None):
        self.__cuda_array_interface__ = {
            "shape": shape,
            "typestr": typestr,
            "strides": strides,
            "data": (0, False),
            "version": 3,
        }


@pytest.mark.skipif(not _core.has_cuda, reason="built without CUDA")
@pytest.mark.parametrize(
    ("means", "error", "message"),
    [
        (
            np.zeros((4, 3), np.float32),
            TypeError,
            "means: expected an array on a CUDA device, got <class 'num",
        ),
        (OnDevice((4, 3), "<f8"), ValueError, "means: expected dtype <f4, got <f8"),
        (OnDevice((4, 2)), ValueError, "means: expected shape (N, 3), got (4, 2)"),
        (OnDevice((12,)), ValueError, "means: expected shape (N, 3), got (12,)"),
        (
            OnDevice((4, 3), strides=(24, 4)),
            ValueError,
            "means: expected a contiguous array, got a strided one",
        ),
    ],
)
def test_wrong_arrays_on_a_device_are_named(means, error, message):
    good, offset = OnDevice((4, 4)), np.array([0, 4])
    with pytest.raises(error, match=re.escape(message)):
        _core.bound_by_boxes_cuda(means, good, OnDevice((4, 3)), offset, OnDevice((1, 2, 3)), 0)
    with pytest.raises(error, match=re.escape(message)):
        _core.median_split_cuda(means, offset, 0, OnDevice((4,), "<i8"), 0)


@pytest.mark.gpu
def test_devices_cannot_be_mixed():
    g = scenes.gaussians([[0, 0, 1], [1, 2, 3]])
    there = g.torch("cuda")
    with pytest.raises(ValueError, match="sh: expected device cuda:0 like the others, got cpu"):
        scenes.replaced(there, sh=g.torch().sh)
    with pytest.raises(TypeError, match="sh: expected a torch tensor like the others, got a NumPy array"):
        scenes.replaced(there, sh=g.sh)


@pytest.mark.gpu
def test_build_of_doubles_is_refused():
    g = scenes.gaussians([[0, 0, 1], [1, 2, 3]]).torch("cuda")
    doubles = v3dg.Gaussians(*(getattr(g, name).double() for name in scenes.NAMES))
    with pytest.raises(ValueError, match="asset: expected float32 arrays, got float64; convert them first"):
        v3dg.build_bundle(doubles, progress=False)


@pytest.mark.gpu
@pytest.mark.parametrize(
    ("mib_left", "message"),
    [
        (64, "out of memory"),  # torch's, which has the result to hold
        (1024, r"cuda: out of memory: asked for .* MiB, free are .* MiB of .* MiB"),  # ours, for scratch
    ],
)
def test_full_device_is_a_memory_error(mib_left, message):
    import torch

    means = torch.zeros((100_000_000, 3), device="cuda")
    torch.cuda.empty_cache()
    free = torch.cuda.mem_get_info()[0]
    rest = torch.empty(max(0, free - (mib_left << 20)), dtype=torch.uint8, device="cuda")
    try:
        with pytest.raises(MemoryError, match=message):
            _operations.median_split(means, 256)
    finally:
        del rest
        torch.cuda.empty_cache()
    order, _ = _operations.median_split(means[:1000], 256)
    assert order.tolist() == list(range(1000))
