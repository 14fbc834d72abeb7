"""Draw scenes, bundles and assets: select a cut, then project, bin and blend it."""

from __future__ import annotations

import time
import weakref
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from v3dg import _core
from v3dg.bundle import Bundle
from v3dg.cameras import Camera
from v3dg.gaussians import Gaussians
from v3dg.rasterize import intrinsics, rows_of, view_of_world
from v3dg.scene import Scene
from v3dg.select import select

if TYPE_CHECKING:
    from collections.abc import Sequence

# px² of screen that one gaussian of a coarser cluster may stand for; docs/levels.md has the error it gives.
DEFAULT_TOLERANCE = 3.0


@dataclass(frozen=True)
class Stats:
    """What a picture cost.

    Attributes:
        gaussians_selected: Gaussians of the selected clusters.
        gaussians_in_frustum: Of them, those in front of the near plane whose extent meets the image, before
            any finer cull.
        select_ms: Time to choose the clusters.
        draw_ms: Time to draw them.
    """

    gaussians_selected: int
    gaussians_in_frustum: int
    select_ms: float
    draw_ms: float


@dataclass(frozen=True, eq=False)
class Image:
    """A picture of H x W pixels.

    Attributes:
        color: (H, W, 3) premultiplied colour, the background composed last.
        alpha: (H, W) coverage.
        depth: (H, W) expected depth along the camera's axis, 0 where nothing was drawn.
        stats: What it cost.
    """

    color: npt.NDArray[np.float32]
    alpha: npt.NDArray[np.float32]
    depth: npt.NDArray[np.float32]
    stats: Stats


def render(
    subject: Scene | Bundle | Gaussians,
    camera: Camera,
    *,
    tolerance: float = DEFAULT_TOLERANCE,
    background: Sequence[float] = (0.0, 0.0, 0.0),
) -> Image:
    """Draw a scene, one bundle or one asset.

    Clusters whose gaussians each stand for at most `tolerance` px² are drawn in place of finer ones; level 0
    with the asset's own filter, coarser levels with the filter they were made for (V3DG, section 3.4; our
    metric is in docs/levels.md). An asset is drawn whole, without a filter.

    Args:
        subject: What to draw, in world space.
        camera: Pinhole camera.
        tolerance: px² of screen per gaussian; 0 draws level 0 everywhere.
        background: Three numbers.

    Raises:
        ValueError: The tolerance is negative, or the background is not three numbers.
    """
    if len(background) != 3:
        raise ValueError(f"background: expected three numbers, got {len(background)}")
    lens = (intrinsics(camera), camera.width, camera.height, [float(b) for b in background], True)
    if isinstance(subject, Gaussians):
        start = time.perf_counter()
        model = _core.Model(*rows_of(subject.numpy()))
        color, alpha, depth, counts, _ = _core.rasterize(
            model, view_of_world(camera), 0.0, False, *lens, False
        )
        milliseconds = 1e3 * (time.perf_counter() - start)
        return Image(color, alpha, depth, Stats(len(subject), counts["in_frustum"], 0.0, milliseconds))

    scene = Scene.of(subject)
    tables = [_table(bundle) for bundle in scene.bundles]
    start = time.perf_counter()
    selection = select(scene, camera, tolerance=tolerance)
    selected = time.perf_counter()
    color, alpha, depth, counts = _core.render_selection(
        tables,
        scene.instance_bundle,
        _views(scene, camera),
        selection.instance_ids,
        selection.cluster_ids,
        *lens,
    )
    drawn = time.perf_counter()
    stats = Stats(
        gaussians_selected=selection.num_gaussians,
        gaussians_in_frustum=counts["in_frustum"],
        select_ms=1e3 * (selected - start),
        draw_ms=1e3 * (drawn - selected),
    )
    return Image(color, alpha, depth, stats)


# A bundle's gaussians as the core lays them out, made when it is first drawn.
_models: weakref.WeakKeyDictionary[Bundle, Any] = weakref.WeakKeyDictionary()


def _table(bundle: Bundle) -> tuple[Any, ...]:
    if bundle not in _models:
        _models[bundle] = _core.Model(*rows_of(bundle.gaussians))
    clusters = bundle.clusters
    return _models[bundle], clusters.offset, clusters.filter_px2, clusters.antialiased


def _views(scene: Scene, camera: Camera) -> npt.NDArray[np.float64]:
    """(I, 15) instance to view for the core, composed in double precision."""
    rotation, translation = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    linear = rotation @ scene.rotations * scene.scales[:, None, None]
    offset = scene.positions @ rotation.T + translation
    from_eye = (camera.position - scene.positions)[:, None, :] @ scene.rotations
    eye = from_eye[:, 0, :] / scene.scales[:, None]
    return np.ascontiguousarray(np.concatenate([linear.reshape(-1, 9), offset, eye], axis=1))
