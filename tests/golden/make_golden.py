"""Writes gsplat_projection.npz: the results of gsplat's functions in plain torch for
the scenes of `golden_scenes`.

Run as `python tests/golden/make_golden.py`. Needs torch and gsplat (`pip install
--no-deps gsplat==1.5.3`), not CUDA.
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np

PATH = Path(__file__).parent / "gsplat_projection.npz"
sys.path.insert(0, str(Path(__file__).parent.parent))
sys.path.insert(0, str(Path(__file__).parent.parent / "support"))

import scenes  # noqa: E402

FILTERS_PX2 = (0.1, 0.3)
NUM = 12


def golden_scenes():
    """Yield the name, the gaussians and the camera of each scene; SH has degree 3."""
    for i, (name, camera) in enumerate(scenes.CAMERAS.items()):
        # Some gaussians are far outside the picture, where the Jacobian is clamped.
        yield (
            name,
            scenes.random_gaussians(
                100 + i, camera, NUM, sh_degree=3, size_px=(0.5, 8), margin=0.7
            ),
            camera,
        )


def load_gsplat():
    """Return gsplat's torch functions as a module; None if gsplat is not installed. The
    package itself needs CUDA."""
    spec = importlib.util.find_spec("gsplat")
    if spec is None or spec.origin is None:
        return None
    path = Path(spec.origin).parent / "cuda" / "_torch_impl.py"
    spec = importlib.util.spec_from_file_location("gsplat_torch_impl", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def evaluate(gsplat, gaussians, camera) -> dict[str, np.ndarray]:
    """Return projections for both filters, colours for all degrees, and gradients of a
    fixed weighted sum of all."""
    import torch

    def leaf(array):
        return torch.from_numpy(np.array(array, np.float64)).requires_grad_()

    means, quats, scales, sh = (
        leaf(getattr(gaussians, n)) for n in ("means", "quats", "scales", "sh")
    )
    viewmat, K = torch.from_numpy(camera.viewmat)[None], torch.from_numpy(camera.K)[None]
    covariance, _ = gsplat._quat_scale_to_covar_preci(quats, scales, True, False)
    out = {}
    for filter_px2 in FILTERS_PX2:
        _, mean_px, depth, conic, compensation = gsplat._fully_fused_projection(
            means,
            covariance,
            viewmat,
            K,
            camera.width,
            camera.height,
            filter_px2,
            camera.near,
            1e10,
            True,
        )
        out |= {
            "mean_px": mean_px[0],
            "depth": depth[0],
            f"conic_{filter_px2}": conic[0],
            f"compensation_{filter_px2}": compensation[0],
        }
    directions = means - torch.from_numpy(camera.position)
    for degree in range(4):
        color = gsplat._spherical_harmonics(degree, directions, sh)
        out[f"color_{degree}"] = torch.clamp_min(color + 0.5, 0)
    loss = sum((value * torch.from_numpy(weights(value.shape))).sum() for value in out.values())
    gradients = torch.autograd.grad(loss, (means, quats, scales, sh))
    out |= dict(zip(("d_means", "d_quats", "d_scales", "d_sh"), gradients, strict=True))
    return {name: value.detach().numpy() for name, value in out.items()}


def weights(shape) -> np.ndarray:
    """Return weights that are fixed, and different for every element."""
    return np.cos(1.0 + 1.7 * np.arange(np.prod(shape), dtype=np.float64)).reshape(shape)


def main() -> None:
    gsplat = load_gsplat()
    if gsplat is None:
        sys.exit("gsplat: not installed; pip install --no-deps gsplat==1.5.3")
    arrays = {}
    for name, gaussians, camera in golden_scenes():
        for key, value in evaluate(gsplat, gaussians, camera).items():
            arrays[f"{name}/{key}"] = value
        # The file contains the scene, so that it stays valid if the generator of scenes
        # changes.
        for key in scenes.NAMES:
            arrays[f"{name}/{key}"] = getattr(gaussians, key)
    np.savez_compressed(PATH, **arrays)
    print(f"{PATH}: {PATH.stat().st_size} bytes")


if __name__ == "__main__":
    main()
