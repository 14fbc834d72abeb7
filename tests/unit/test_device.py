"""Tests devices. The helpers of the tests copy arrays to them, and requesting CUDA
where it is missing is an error."""

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
from v3dg import _core, _device
from v3dg._device import CPU, Device

BUILT_WITHOUT = "v3dg was built without CUDA; install it again where nvcc is found"
NO_DEVICE = "expected a CUDA device and its driver, got none; install the driver"


def test_arrays_go_to_a_device_and_back(device):
    asset = scenes.gaussians([[0, 0, 1], [1, 2, 3]])
    there = devices.on(device, asset)
    assert ("cuda" in repr(there)) == (device == "cuda")
    back = devices.host(there)
    for name in scenes.NAMES:
        np.testing.assert_array_equal(getattr(back, name), getattr(asset, name))


@pytest.mark.parametrize("name", ["gpu", "cuda:", "cuda:-1", "cuda:x", "cpu:0", "auto:1", ""])
def test_unknown_device_is_named(name):
    with pytest.raises(
        ValueError, match=f"device: expected 'auto', 'cpu', 'cuda' or 'cuda:1', got '{name}'"
    ):
        _device.resolve(name)


def test_auto_is_the_cpu_where_cuda_is_missing(monkeypatch):
    assert _device.resolve("cpu") == _device.resolve(CPU) == CPU
    monkeypatch.setattr(_device, "missing_for_cuda", lambda: "something")
    assert _device.resolve("auto") == CPU
    with pytest.raises(RuntimeError, match="device: something, or use 'cpu'"):
        _device.resolve("cuda")


@pytest.mark.gpu
def test_auto_is_cuda_where_nothing_is_missing():
    import torch

    current = Device(torch.cuda.current_device())
    assert _device.resolve("auto") == _device.resolve("cuda") == current
    assert _device.resolve(str(current)) == _device.resolve(current) == current


@pytest.mark.gpu
def test_device_that_is_not_there_is_named():
    count = _core.num_cuda_devices()
    message = f"device: expected the index of one of {count} CUDA devices, got 'cuda:{count}'"
    with pytest.raises(RuntimeError, match=message):
        _device.resolve(f"cuda:{count}")
    with pytest.raises(RuntimeError, match="cuda"):
        _core.SceneFrame(count)


def test_device_says_what_it_is():
    assert (str(CPU), CPU.is_cuda) == ("cpu", False)
    assert (str(Device(1)), Device(1).is_cuda) == ("cuda:1", True)
    assert {Device(1): "kept"}[Device(1)] == "kept"
    asset = scenes.gaussians([[0, 0, 1]])
    assert _device.of(asset.means) == CPU


@pytest.mark.gpu
def test_device_of_a_tensor_is_where_it_is():
    there = scenes.gaussians([[0, 0, 1]]).torch("cuda")
    assert _device.of(there.means) == Device(there.means.device.index) == Device(there.rows.device)
    assert _device.of(there.means.cpu()) == CPU


@pytest.mark.skipif(_core.num_cuda_devices() > 0, reason="there is a CUDA device")
def test_missing_device_is_named():
    expected = NO_DEVICE if _core.has_cuda else BUILT_WITHOUT
    with pytest.raises(RuntimeError, match=f"device: {expected}, or use 'cpu'"):
        _device.resolve("cuda")


# The script has the error of `import torch` without torch, and a core that has a
# device.
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
        "RuntimeError: device: CUDA and gradients: expected torch>=2.2, got no package or an "
        "older version; run pip install 'torch>=2.2', or use 'cpu'"
    )


# ---- arguments of the core


class OnDevice:
    """The attributes of an array on a device that the core reads. There is no device;
    the attributes suffice for the array to be rejected."""

    def __init__(self, shape, typestr="<f4", strides=None):
        self.shape = shape
        self.__cuda_array_interface__ = {
            "shape": shape,
            "typestr": typestr,
            "strides": strides,
            "data": (0, False),
            "version": 3,
        }


SHAPES = {"means": (4, 3), "quats": (4, 4), "scales": (4, 3), "opacities": (4,), "sh": (4, 1, 3)}


def rows(make, **changes):
    """Return the core's rows of four gaussians. A function creates each array from its
    shape."""
    return _core.Rows(**{name: make(shape) for name, shape in SHAPES.items()} | changes)


def zeros(shape):
    return np.zeros(shape, np.float32)


@pytest.mark.skipif(not _core.has_cuda, reason="built without CUDA")
@pytest.mark.parametrize(
    ("means", "error", "message"),
    [
        (OnDevice((4, 3), "<f8"), ValueError, "means: expected dtype <f4, got <f8"),
        (OnDevice((4, 2)), ValueError, "means: expected shape (?, 3), got (4, 2)"),
        (OnDevice((12,)), ValueError, "means: expected shape (N, 3), got (12,)"),
        (
            OnDevice((4, 3), strides=(24, 4)),
            ValueError,
            "means: expected a contiguous array, got a strided one",
        ),
    ],
)
def test_wrong_arrays_on_a_device_are_named(means, error, message):
    # The number of rows may be named as 4 or N.
    pattern = re.escape(message).replace(r"\?", "[4N]")
    with pytest.raises(error, match=pattern):
        rows(OnDevice, means=means)
    with pytest.raises(error, match=pattern):
        _core.median_split(means, np.array([0, 4]), 0)


@pytest.mark.skipif(not _core.has_cuda, reason="built without CUDA")
@pytest.mark.parametrize("name", ["quats", "scales", "opacities", "sh"])
def test_rows_of_mixed_devices_are_refused(name):
    with pytest.raises(
        TypeError, match=f"{name}: expected a NumPy array, got <class '.*OnDevice'>"
    ):
        rows(zeros, **{name: OnDevice(SHAPES[name])})
    with pytest.raises(
        TypeError, match=f"{name}: expected an array on a CUDA device, got <class 'num"
    ):
        rows(OnDevice, **{name: zeros(SHAPES[name])})


@pytest.mark.skipif(_core.has_cuda, reason="built with CUDA")
def test_arrays_on_a_device_need_a_core_with_cuda():
    message = f"means: this array is on a CUDA device, but {BUILT_WITHOUT}"
    with pytest.raises(RuntimeError, match=message):
        rows(OnDevice)
    with pytest.raises(RuntimeError, match=message):
        _core.median_split(OnDevice((4, 3)), np.array([0, 4]), 0)
    for kind in (_core.ResidentScene, _core.SceneFrame):
        with pytest.raises(RuntimeError, match=f"device: {BUILT_WITHOUT}"):
            kind(0)


@pytest.mark.gpu
def test_rows_of_doubles_on_a_device_are_refused():
    with pytest.raises(ValueError, match="means: expected dtype <f4, got <f8"):
        rows(lambda shape: devices.on("cuda", np.zeros(shape)))


@pytest.mark.gpu
def test_rows_that_begin_between_words_are_copied():
    """The tensor is a part of another one and is not aligned, so the core could not
    read four floats at once."""
    many = scenes.gaussians([[0, 0, 1], [1, 2, 3], [4, 5, 6]])
    there, last = many.torch("cuda"), slice(1, None)
    with pytest.raises(ValueError, match="quats, sh: expected memory that is aligned to 16 bytes"):
        _core.Rows(*(getattr(there, name)[last] for name in scenes.NAMES))
    box = _core.bound_by_boxes(there.subset(last).rows, np.array([0, 2]))
    np.testing.assert_array_equal(
        devices.host(box), _core.bound_by_boxes(many.subset(last).rows, np.array([0, 2]))
    )


@pytest.mark.gpu
def test_devices_cannot_be_mixed():
    g = scenes.gaussians([[0, 0, 1], [1, 2, 3]])
    there = g.torch("cuda")
    with pytest.raises(
        ValueError, match="sh: expected device cuda:0 like the other arrays, got cpu"
    ):
        scenes.replaced(there, sh=g.torch().sh)
    with pytest.raises(
        TypeError, match="sh: expected a torch tensor like the other arrays, got a NumPy array"
    ):
        scenes.replaced(there, sh=g.sh)


@pytest.mark.gpu
def test_build_of_doubles_is_refused():
    g = scenes.gaussians([[0, 0, 1], [1, 2, 3]]).torch("cuda")
    doubles = v3dg.Gaussians(*(getattr(g, name).double() for name in scenes.NAMES))
    with pytest.raises(
        ValueError, match="asset: expected float32 arrays, got float64; convert them first"
    ):
        v3dg.build_bundle(doubles, progress=False)


@pytest.mark.gpu
@pytest.mark.parametrize(
    ("mib_left", "message"),
    [
        (64, "out of memory"),  # torch's memory, for the result
        (
            1024,
            r"cuda: out of memory: requested .* MiB, free: .* MiB of .* MiB",
        ),  # v3dg's memory, for scratch data
    ],
)
def test_full_device_is_a_memory_error(mib_left, message):
    import torch

    def split(means):
        depth = _core.num_halvings(len(means), 256)
        return _core.median_split(means, np.array([0, len(means)]), depth)

    means = torch.zeros((100_000_000, 3), device="cuda")
    with devices.free_memory(mib_left << 20), pytest.raises(MemoryError, match=message):
        split(means)
    order, _ = split(means[:1000])
    assert order.tolist() == list(range(1000))
