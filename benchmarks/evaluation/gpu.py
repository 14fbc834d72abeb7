"""Shared parts of the benchmarks on a GPU: memory, errors, and pictures by gsplat for
comparison."""

from __future__ import annotations

import importlib.util
import threading
from collections.abc import Callable
from types import TracebackType
from typing import Any

import v3dg
from benchmarks.evaluation.measure import Time, time_ms
from v3dg import _core
from v3dg.cameras import Camera
from v3dg.scene import Scene

DEVICE = "cuda"


class PeakMemory:
    """Measures the peak of GPU memory in a `with` block, beyond that of an idle
    process.

    The result is in `gigabytes`. Free memory is read from the driver every few
    milliseconds, so allocations of other processes and the caches of memory pools
    count, too.
    """

    _idle = 0

    def __enter__(self) -> PeakMemory:
        import torch

        torch.cuda.synchronize()
        torch.cuda.empty_cache()
        self._free = torch.cuda.mem_get_info
        self._least = self._free()[0]
        if not PeakMemory._idle:
            PeakMemory._idle = self._least
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._watch)
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._done.set()
        self._thread.join()
        self.gigabytes = (PeakMemory._idle - self._least) / 1e9

    def _watch(self) -> None:
        while not self._done.wait(0.005):
            self._least = min(self._least, self._free()[0])


def picture_error(picture: Any, truth: Any) -> dict[str, float]:
    """Return the error of a picture against a reference, with both pictures clipped to
    [0, 1]."""
    import torch

    picture, truth = (torch.as_tensor(p, device=DEVICE).clamp(0, 1) for p in (picture, truth))
    error = (picture - truth).abs()
    mean_square = float(error.double().square().mean())
    return {
        "largest_error": round(float(error.max()), 6),
        "mean_error": round(float(error.mean()), 8),
        "psnr": round(-10 * torch.tensor(max(mean_square, 1e-20)).log10().item(), 2),
        "share_over_1_255": round(float((error.amax(-1) > 1 / 255).double().mean()), 8),
    }


def placed_gaussians(scene: Scene, device: str = DEVICE) -> v3dg.Gaussians:
    """Return the gaussians of all instances of a scene with one bundle, at full detail,
    in world space.

    The result has tensors, and colours of SH degree 0.
    """
    import torch

    asset = scene.bundles[0].level_gaussians(0).torch(device)
    means = torch.empty(len(scene), len(asset), 3, device=device)
    quats = torch.empty(len(scene), len(asset), 4, device=device)
    product = torch.as_tensor(_left_products(scene.quaternions), device=device)
    linear = torch.as_tensor(scene.rotations * scene.scales[:, None, None], device=device)
    positions = torch.as_tensor(scene.positions, device=device)
    for i in range(len(scene)):
        means[i] = asset.means.double() @ linear[i].T + positions[i]
        quats[i] = asset.quats.double() @ product[i].T
    scales = torch.as_tensor(scene.scales, device=device).float()[:, None, None] * asset.scales
    opacities = asset.opacities.expand(len(scene), -1)
    sh = asset.sh.expand(len(scene), -1, -1, -1)
    return v3dg.Gaussians(
        means.flatten(0, 1),
        quats.flatten(0, 1),
        scales.flatten(0, 1).contiguous(),
        opacities.flatten().contiguous(),
        sh.flatten(0, 1).contiguous(),
    )


def _left_products(quaternions: Any) -> Any:
    """Return (I, 4, 4) matrices that multiply quaternions by the given ones from the
    left."""
    import torch

    w, x, y, z = torch.as_tensor(quaternions).unbind(-1)
    rows = [[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def base_color(gaussians: v3dg.Gaussians) -> Any:
    """Return the colours (N, 3) of SH degree 0, tensors."""
    return (gaussians.sh[:, 0] * _core.sh_base0 + 0.5).clamp_min(0)


def has_gsplat() -> bool:
    """Return whether gsplat is installed, so that it can be measured."""
    return importlib.util.find_spec("gsplat") is not None


def time_gsplat(gaussians: v3dg.Gaussians, camera: Camera, repeats: int) -> Time:
    """Measure a frame of gsplat in its packed and unpacked modes; return the faster
    one."""

    import torch

    def measure(packed: bool) -> Time:
        return time_ms(lambda: gsplat_picture(gaussians, camera, packed=packed), DEVICE, repeats)

    with torch.no_grad():
        return min((measure(packed) for packed in (True, False)), key=lambda t: t.median)


def gsplat_picture(
    gaussians: v3dg.Gaussians, camera: Camera, *, packed: bool, eps2d: float = 0.0
) -> tuple[Any, Any]:
    """Return colour (H, W, 3) and alpha (H, W) as drawn by gsplat; differentiable."""
    return gsplat_frame(gaussians, camera, packed=packed, eps2d=eps2d)()


def gsplat_frame(
    gaussians: v3dg.Gaussians, camera: Camera, *, packed: bool, eps2d: float = 0.0
) -> Callable[[], tuple[Any, Any]]:
    """Return a function that draws `gsplat_picture` from inputs that are on the GPU.

    Colours that do not depend on the view are passed directly, which spares gsplat a
    pass over the gaussians.
    """
    import gsplat
    import torch

    if gaussians.sh_degree == 0:
        colors, degree = base_color(gaussians), None
    else:
        colors, degree = gaussians.sh, gaussians.sh_degree
    device = gaussians.means.device
    viewmat, K = (
        torch.as_tensor(m, dtype=torch.float32, device=device) for m in (camera.viewmat, camera.K)
    )

    def draw() -> tuple[Any, Any]:
        color, alpha, _ = gsplat.rasterization(
            gaussians.means,
            gaussians.quats,
            gaussians.scales,
            gaussians.opacities,
            colors,
            viewmat[None],
            K[None],
            camera.width,
            camera.height,
            near_plane=camera.near,
            eps2d=eps2d,
            sh_degree=degree,
            packed=packed,
        )
        return color[0], alpha[0, ..., 0]

    return draw
