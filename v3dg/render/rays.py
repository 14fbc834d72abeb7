"""Rays of spherical sensors, cast through scenes, bundles and assets on the CPU."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from v3dg import _core, _device
from v3dg._device import CPU, Device
from v3dg._numbers import check
from v3dg._numbers import color as color_of
from v3dg.gaussians import TRAINED_FILTER_PX2, Gaussians
from v3dg.image import Image
from v3dg.render.asset_frame import check_request
from v3dg.residency import residency
from v3dg.spherical import MIN_TRANSMITTANCE, EquirectangularCamera

if TYPE_CHECKING:
    from collections.abc import Sequence

    from v3dg.false_color import ColorBy
    from v3dg.render.request import CutRequest
    from v3dg.scene import Subject
    from v3dg.select import Selection


def check_rays_device(device: str | Device) -> None:
    """Raise ValueError for a CUDA device: rays are cast on the CPU only."""
    if device == "auto":
        return
    target = _device.resolve(device)
    expected = f"'cpu' or 'auto', because rays are cast on the CPU only, got {str(target)!r}"
    check("device", not target.is_cuda, expected)


def check_rays(
    color_by: ColorBy,
    cut: Selection | None,
    sensor: _core.Sensor | None,
    min_transmittance: float | None,
    device: str | Device,
    memory: int | str | None,
) -> None:
    """Raise ValueError for options of pictures that rays do not have."""
    check("cut", cut is None, "none for an equirectangular camera, got one; leave it out")
    check("color_by", color_by == "appearance", f"'appearance' for rays, got {color_by!r}")
    check("channels, mesh", sensor is None, "none but 'depth' for rays, got others; leave them out")
    expected = f"None for rays, which end at {MIN_TRANSMITTANCE:g}, got {min_transmittance}"
    check("min_transmittance", min_transmittance is None, expected)
    expected = f"'auto' or None for rays, which need all gaussians in memory, got {memory!r}"
    check("memory", memory in ("auto", None), expected)
    check_rays_device(device)


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
    background: Sequence[float],
    *,
    depth: bool,
) -> Image:
    """Draw an equirectangular picture; its depth is the mean distance along the ray, by
    blend weight."""
    back_color = color_of(background, "background")
    cast = cast_rays(subject, camera.core, cut)
    table = camera.table
    alpha = table.in_order(cast.alpha)
    color = table.in_order(cast.color)
    if any(back_color):
        color += (1 - alpha[..., None]) * np.array(back_color, np.float32)
    distance = None
    if depth:
        distance = table.in_order(cast.range)
    return Image(color, alpha, distance)
