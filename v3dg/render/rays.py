"""Rays of spherical sensors, cast through scenes, bundles and assets."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from v3dg import _core, _device
from v3dg._numbers import check
from v3dg._numbers import color as color_of
from v3dg.gaussians import TRAINED_FILTER_PX2, Gaussians
from v3dg.image import Image
from v3dg.render.asset_frame import check_request
from v3dg.render.resident_frame import ResidentFrame
from v3dg.residency import residency
from v3dg.spherical import MIN_TRANSMITTANCE, EquirectangularCamera

if TYPE_CHECKING:
    from collections.abc import Sequence

    from v3dg._device import Device
    from v3dg.bundle import Bundle
    from v3dg.false_color import ColorBy
    from v3dg.gaussians import Array
    from v3dg.render.request import CutRequest
    from v3dg.scene import Subject
    from v3dg.select import Selection


class RayImage(Image):
    """A picture that was drawn by casting rays.

    Attributes:
        gaussians: Number of gaussians in the selected clusters.
    """

    def __init__(self, color: Array, alpha: Array, depth: Array | None, gaussians: int) -> None:
        super().__init__(color, alpha, depth)
        self.gaussians = gaussians


class RayFrame(ResidentFrame):
    """Casts rays through a scene or a bundle on one device. The buffers are reused from
    cast to cast, and the frame does not keep the subject alive."""

    def __init__(self, device: Device) -> None:
        super().__init__(device)
        self._core = _core.RayFrame(device.number)

    def _set_models(self, bundles: Sequence[Bundle]) -> None:
        self._core.set_models([residency.model(bundle, self.device) for bundle in bundles])

    def cast(
        self,
        subject: Subject,
        sensor: _core.RaySensor,
        viewmats: Array,
        cut: CutRequest,
        environments: Array | None,
        returns: tuple[float, float] | None,
    ) -> _core.Cast:
        """Cast the rays of a sensor at each of B poses; see `cast_rays`."""
        with residency.turn(self.device):
            resident = self._taken(subject)
            return self._core.cast_scene(
                resident.core, sensor, viewmats, cut.rule, environments, returns
            )


def check_rays(
    color_by: ColorBy,
    cut: Selection | None,
    sensor: _core.Sensor | None,
    min_transmittance: float | None,
    memory: int | str | None,
) -> None:
    """Raise ValueError for options of `render` that rays do not support."""
    check("cut", cut is None, "none for an equirectangular camera, got one; leave it out")
    check("color_by", color_by == "appearance", f"'appearance' for rays, got {color_by!r}")
    check("channels, mesh", sensor is None, "none but 'depth' for rays, got others; leave them out")
    expected = f"None for rays, which end at {MIN_TRANSMITTANCE:g}, got {min_transmittance}"
    check("min_transmittance", min_transmittance is None, expected)
    expected = f"'auto' or None for rays, which need all gaussians in memory, got {memory!r}"
    check("memory", memory in ("auto", None), expected)


def cast_rays(
    subject: Subject,
    sensor: _core.RaySensor,
    viewmats: Array,
    cut: CutRequest,
    device: Device,
    *,
    environments: Array | None = None,
    returns: tuple[float, float] | None = None,
) -> _core.Cast:
    """Cast the rays of a sensor at each of B poses, through the cut of a scene or a
    bundle, or through all gaussians of an asset.

    Args:
        viewmats: (B, 4, 4) from world to sensor, as doubles in host memory, or as a
            float32 or float64 tensor on the device.
        environments: (B,) int32 or, on a CUDA device, int64, where the poses are. None
            for sensors that see all instances.
        returns: The minimum weight of a return, and the gap after it; None to compute
            colour and range instead.

    Raises:
        ValueError: The cut has a budget, an asset has a cut or environments, or an
            environment on the host is none of the scene's.
    """
    check("budget", cut.budget is None, "none for rays, got one; leave it out")
    if device.is_cuda:
        import torch

        viewmats = torch.as_tensor(viewmats, device=str(device)).contiguous()
    if isinstance(subject, Gaussians):
        expected = "None for an asset, which has no instances, got numbers"
        check("environment", environments is None, expected)
        return _cast_asset(subject, sensor, viewmats, cut, device, returns)
    frame = residency.once(subject, ("frame", "rays", device), lambda: RayFrame(device))
    return frame.cast(subject, sensor, viewmats, cut, environments, returns)


def _cast_asset(
    asset: Gaussians,
    sensor: _core.RaySensor,
    viewmats: Array,
    cut: CutRequest,
    device: Device,
    returns: tuple[float, float] | None,
) -> _core.Cast:
    check_request(cut)
    filter_px2 = 0.0
    if asset.antialiased:
        filter_px2 = TRAINED_FILTER_PX2
    model = _core.Model(_device.place(asset, device).rows)
    return _core.RayFrame(device.number).cast_model(
        model,
        sensor,
        viewmats,
        filter_px2=filter_px2,
        antialiased=bool(asset.antialiased),
        returns=returns,
    )


def draw_rays(
    subject: Subject,
    camera: EquirectangularCamera,
    cut: CutRequest,
    background: Sequence[float],
    device: str | Device,
    *,
    depth: bool,
) -> RayImage:
    """Draw an equirectangular picture. Its depth is the mean distance along the ray,
    weighted by blend weights."""
    back_color = color_of(background, "background")
    if str(device) == "webgpu":
        raise ValueError(
            "camera: expected a pinhole with device='webgpu', got an EquirectangularCamera; use "
            "'cpu' or 'cuda'"
        )
    chosen_device = _device.resolve(device)
    cast = cast_rays(subject, camera.core, camera.sensor_viewmat[None], cut, chosen_device)
    color = cast.color[0]
    alpha = cast.alpha[0]
    if any(back_color):
        backdrop: Array = np.array(back_color, np.float32)
        if chosen_device.is_cuda:
            import torch

            backdrop = torch.as_tensor(backdrop, device=str(chosen_device))
        color += (1 - alpha[..., None]) * backdrop
    distance = None
    if depth:
        distance = cast.range[0]
    return RayImage(color, alpha, distance, cast.gaussians[0])
