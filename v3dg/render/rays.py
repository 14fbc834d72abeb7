"""Rays of spherical sensors, cast through scenes, bundles and assets on the CPU."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from v3dg import _core, _device
from v3dg._device import CPU, Device
from v3dg._numbers import check
from v3dg.gaussians import TRAINED_FILTER_PX2, Gaussians
from v3dg.image import Image
from v3dg.render.asset_frame import check_request
from v3dg.residency import residency

if TYPE_CHECKING:
    from v3dg.render.request import CutRequest
    from v3dg.scene import Subject
    from v3dg.spherical import EquirectangularCamera, RayTable


def check_rays_device(device: str | Device) -> None:
    """Raise ValueError for a CUDA device: rays are cast on the CPU only."""
    if device == "auto":
        return
    target = _device.resolve(device)
    expected = f"'cpu' or 'auto', because rays are cast on the CPU only, got {str(target)!r}"
    check("device", not target.is_cuda, expected)


def cast_rays(
    subject: Subject,
    sensor: _core.RaySensor,
    cut: CutRequest,
    returns: tuple[float, float] | None = None,
) -> _core.Cast:
    """Cast the rays of a sensor through the cut of a scene or a bundle, or through all
    of an asset.

    Args:
        returns: The least weight of a return, and the gap behind it; None for colour
            and range.

    Raises:
        ValueError: The cut has a budget, or an asset is drawn with a cut.
    """
    check("budget", cut.budget is None, "none for rays, got one; leave it out")
    if isinstance(subject, Gaussians):
        return _cast_asset(subject, sensor, cut, returns)
    with residency.turn(CPU):
        resident = residency.scene(subject, CPU)
        models = [residency.model(bundle, CPU) for bundle in resident.bundles]
        return _core.cast_scene(resident.core, models, sensor, cut.rule, returns)


def _cast_asset(
    asset: Gaussians,
    sensor: _core.RaySensor,
    cut: CutRequest,
    returns: tuple[float, float] | None,
) -> _core.Cast:
    check_request(cut)
    filter_px2 = 0.0
    if asset.antialiased:
        filter_px2 = TRAINED_FILTER_PX2
    model = _core.Model(_device.place(asset, CPU).rows)
    antialiased = bool(asset.antialiased)
    return _core.cast_model(
        model, sensor, filter_px2=filter_px2, antialiased=antialiased, returns=returns
    )


def draw_sphere(
    subject: Subject,
    camera: EquirectangularCamera,
    cut: CutRequest,
    background: list[float],
    *,
    depth: bool,
) -> Image:
    """Draw an equirectangular picture; its depth is the mean distance along the ray, by
    blend weight."""
    cast = cast_rays(subject, camera.core, cut)
    table: RayTable = camera.table
    alpha = table.in_order(cast.alpha)
    color = table.in_order(cast.color)
    if any(background):
        color += (1 - alpha[..., None]) * np.float32(background)
    distance = None
    if depth:
        distance = table.in_order(cast.range)
    return Image(color, alpha, distance)
