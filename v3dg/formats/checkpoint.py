"""Checkpoints of trainers, `.pt` and `.ckpt`: gsplat's `simple_trainer`, and splatfacto of nerfstudio.

Both hold means, log scales, quaternions w x y z, logits of opacities and SH coefficients as tensors, gsplat
in a dict `splats`, nerfstudio among the values of `pipeline`. Nothing else of the pickle is executed or kept.
"""

from __future__ import annotations

import os
import warnings
from typing import Any

from v3dg import _files
from v3dg.formats._packing import DEGREES, Floats, assemble, normalised, problem
from v3dg.gaussians import Gaussians

# Field: its name in gsplat's checkpoints, in nerfstudio's.
_FIELDS = {
    "means": ("means", "means"),
    "scales": ("scales", "scales"),
    "quats": ("quats", "quats"),
    "opacities": ("opacities", "opacities"),
    "sh0": ("sh0", "features_dc"),
    "shN": ("shN", "features_rest"),
}
_NERFSTUDIO_PREFIX = "_model.gauss_params."


def read(path: str | os.PathLike[str]) -> Gaussians:
    """Read the gaussians of a checkpoint.

    Raises:
        ValueError: It is none of the two, or its pickle wants more than tensors and plain values.
        ImportError: torch is missing.
        OSError: It cannot be read.
    """
    tensors = _tensors(path, _loaded(path))
    count = len(tensors["means"])
    shapes = {
        "means": (count, 3),
        "scales": (count, 3),
        "quats": (count, 4),
        "opacities": (count,),
        "sh0": (count, 3),
    }
    num_higher = tensors["shN"].numel() // max(1, 3 * count)
    if num_higher not in DEGREES:
        raise problem(path, f"expected SH degree 0 to 3, got shN of shape {tuple(tensors['shN'].shape)}")
    shapes["shN"] = (count, num_higher, 3)
    arrays = {}
    for name, shape in shapes.items():
        tensor = tensors[name]
        if tensor.numel() != _product(shape):
            raise problem(path, f"expected {name} of shape {shape}, got {tuple(tensor.shape)}")
        arrays[name] = tensor.detach().double().reshape(shape)
    import torch

    def decode(rows: slice) -> tuple[Floats, ...]:
        block = {name: array[rows] for name, array in arrays.items()}
        sh = torch.cat([block["sh0"][:, None], block["shN"]], dim=1)
        scales, opacities = block["scales"].exp(), block["opacities"].sigmoid()
        return (
            block["means"].numpy(),
            normalised(block["quats"].numpy()),
            scales.numpy(),
            opacities.numpy(),
            sh.numpy(),
        )

    return assemble(count, DEGREES[num_higher], decode)


def _product(shape: tuple[int, ...]) -> int:
    product = 1
    for size in shape:
        product *= size
    return product


def _loaded(path: str | os.PathLike[str]) -> Any:
    try:
        import torch
    except ImportError:
        raise ImportError(f"{os.fspath(path)}: a checkpoint needs torch; pip install 'v3dg[torch]'") from None
    with _files.naming_errors(path), open(_files.open_regular(path), "rb") as file:
        file.read(1)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what torch warns of in damaged files becomes an error below
            # Mapped: a checkpoint's optimiser is twice as large as its gaussians, and is not read.
            return torch.load(os.fspath(path), map_location="cpu", weights_only=True, mmap=True)
    except MemoryError:
        raise
    except Exception as error:  # damaged files raise RuntimeError, EOFError, OSError, UnpicklingError, ...
        lines = [ascii(line)[1:-1] for line in str(error).splitlines()]
        wanted = next((line for line in lines if "GLOBAL" in line or "Unsupported" in line), None)
        found = (
            f"one that wants more: {wanted}"
            if wanted
            else f"a file that torch cannot read: {' '.join(lines)}"
        )
        raise problem(path, f"expected a checkpoint of tensors and plain values, got {found[:200]}") from None


def _tensors(path: str | os.PathLike[str], content: Any) -> dict[str, Any]:
    import torch

    found: dict[str, Any] = {}
    if isinstance(content, dict) and isinstance(content.get("splats"), dict):
        found = {name: content["splats"].get(key) for name, (key, _) in _FIELDS.items()}
    elif isinstance(content, dict) and isinstance(content.get("pipeline"), dict):
        found = {
            name: content["pipeline"].get(_NERFSTUDIO_PREFIX + key) for name, (_, key) in _FIELDS.items()
        }
    else:
        keys = (
            ", ".join(ascii(key) for key in list(content)[:6]) if isinstance(content, dict) else type(content)
        )
        raise problem(
            path, f"expected 'splats' (gsplat) or 'pipeline' (nerfstudio) in the checkpoint, got {keys}"
        )
    for name, tensor in found.items():
        if not isinstance(tensor, torch.Tensor) or not tensor.is_floating_point() or tensor.ndim == 0:
            raise problem(
                path, f"expected a tensor of floats {name} in the checkpoint, got {type(tensor).__name__}"
            )
    return found
