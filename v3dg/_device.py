"""Where work runs: on the CPU, with NumPy arrays, or on a CUDA device, with torch tensors."""

from __future__ import annotations

from typing import Literal

from v3dg import _core


def resolve(device: str) -> Literal["cpu", "cuda"]:
    """The device that "auto", "cpu" or "cuda" stands for; "auto" is CUDA where nothing is missing for it.

    Raises:
        ValueError: It is none of the three.
        RuntimeError: It is "cuda", and something is missing; never another device in its place.
    """
    if device not in ("auto", "cpu", "cuda"):
        raise ValueError(f"device: expected 'auto', 'cpu' or 'cuda', got {device!r}")
    if device == "cpu":
        return "cpu"
    missing = missing_for_cuda()
    if missing is None:
        return "cuda"
    if device == "cuda":
        raise RuntimeError(f"device: {missing}; or use 'cpu'")
    return "cpu"


def missing_for_cuda() -> str | None:
    """What has to be done before CUDA can be used; None where it can."""
    if not _core.has_cuda:
        return "v3dg was built without CUDA; install it again where nvcc is found"
    if _core.num_cuda_devices() == 0:
        return "expected a CUDA device and its driver, found none"
    try:
        import torch
    except ImportError:
        return "expected torch, which owns arrays on CUDA devices; pip install 'v3dg[torch]'"
    if not torch.cuda.is_available():
        return (
            f"expected a torch that can use the CUDA device, got {torch.__version__}; install one with CUDA"
        )
    return None
