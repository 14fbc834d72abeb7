"""Draw scenes, bundles and assets: select a cut, then project, bin and blend it."""

from __future__ import annotations

import time
import weakref
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from v3dg import _core, _device
from v3dg.bundle import Bundle
from v3dg.cameras import Camera
from v3dg.gaussians import Gaussians
from v3dg.rasterize import intrinsics, rows_of, view_of_world
from v3dg.scene import Scene
from v3dg.select import select

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

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


class Image:
    """A picture of H x W pixels: NumPy arrays, or torch tensors on the CUDA device that drew it.

    A picture drawn by CUDA may still be under way; to look at one of its attributes waits until it is there.

    Attributes:
        color: (H, W, 3) premultiplied colour, the background composed last.
        alpha: (H, W) coverage.
        depth: (H, W) expected depth along the camera's axis, 0 where nothing was drawn.
        stats: What it cost.
    """

    def __init__(self, color: Any, alpha: Any, depth: Any, finish: Callable[[], Stats]) -> None:
        self._picture, self._finish = (color, alpha, depth), finish

    @property
    def color(self) -> Any:
        self._finish()
        return self._picture[0]

    @property
    def alpha(self) -> Any:
        self._finish()
        return self._picture[1]

    @property
    def depth(self) -> Any:
        self._finish()
        return self._picture[2]

    @property
    def stats(self) -> Stats:
        return self._finish()


def render(
    subject: Scene | Bundle | Gaussians,
    camera: Camera,
    *,
    tolerance: float = DEFAULT_TOLERANCE,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    device: str = "cpu",
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
        device: "cpu", "cuda" or "auto"; CUDA draws on torch's current stream and keeps on the device what the
            next picture of the same scene or bundle needs. Use a `Renderer` to say how long.

    Raises:
        ValueError: The tolerance is negative, or the background is not three numbers.
        RuntimeError: `device` is "cuda" and something is missing for it.
    """
    if _device.resolve(device) == "cuda":
        return _renderer_of(subject).render(camera, tolerance=tolerance, background=background)
    _check(tolerance, background)
    lens = (intrinsics(camera), camera.width, camera.height, [float(b) for b in background], True)
    if isinstance(subject, Gaussians):
        start = time.perf_counter()
        model = _core.Model(*rows_of(subject.numpy()))
        color, alpha, depth, counts, _ = _core.rasterize(
            model, view_of_world(camera), 0.0, False, *lens, False
        )
        milliseconds = 1e3 * (time.perf_counter() - start)
        asset_stats = Stats(len(subject), counts["in_frustum"], 0.0, milliseconds)
        return Image(color, alpha, depth, lambda: asset_stats)

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
    return Image(color, alpha, depth, lambda: stats)


class Renderer:
    """Draws one scene, bundle or asset on torch's current CUDA device, with what that needs.

    Enqueuing a picture waits for nothing, so pictures can be drawn ahead, and captured in a CUDA graph: draw
    once what the graph will meet, so that there is memory enough, then capture `render`. Keep the renderer as
    long as the graph. What is added to a scene later is not drawn.

    Raises:
        RuntimeError: Something is missing for CUDA.
    """

    def __init__(self, subject: Scene | Bundle | Gaussians) -> None:
        _device.resolve("cuda")
        self._device = _device.current_device()
        self._shown: tuple[Any, ...] = ()
        if isinstance(subject, Gaussians):
            rows = _rows_on_device(subject)
            self._frame: Any = _core.ModelFrame(rows, _device.current_stream())
            return
        scene = Scene.of(subject)
        self._shown = _shown(scene)
        bundles = [
            (_rows_of_bundle(bundle), bundle.clusters.filter_px2, bundle.clusters.antialiased)
            for bundle in scene.bundles
        ]
        self._frame = _core.SceneFrame(
            bundles,
            scene.tables,
            scene.instance_bundle,
            scene.positions,
            scene.rotations,
            scene.scales,
            _device.current_stream(),
        )

    def render(
        self,
        camera: Camera,
        *,
        tolerance: float = DEFAULT_TOLERANCE,
        background: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> Image:
        """Draw on torch's current stream, as `v3dg.render` does."""
        _check(tolerance, background)
        shape = (camera.height, camera.width)
        picture = (_empty((*shape, 3)), _empty(shape), _empty(shape))
        last = ([float(b) for b in background], picture, _device.current_stream())
        if isinstance(self._frame, _core.SceneFrame):
            drawing = self._frame.draw(
                camera.viewmat, camera.position, camera.K, camera.near, float(tolerance), *last
            )
        else:
            drawing = self._frame.draw(view_of_world(camera), 0.0, False, intrinsics(camera), *last)

        def finish() -> Stats:
            counts = drawing.finish()
            return Stats(counts["gaussians"], counts["in_frustum"], counts["select_ms"], counts["draw_ms"])

        return Image(*picture, finish)

    def _draws(self, scene: Scene) -> bool:
        shown = _shown(scene)
        same = len(shown) == len(self._shown) and all(a is b for a, b in zip(shown, self._shown, strict=True))
        return same and self._device == _device.current_device()


def _check(tolerance: float, background: Sequence[float]) -> None:
    if not tolerance >= 0:
        raise ValueError(f"tolerance: expected 0 px² or more, got {tolerance}")
    if len(background) != 3:
        raise ValueError(f"background: expected three numbers, got {len(background)}")


def _shown(scene: Scene) -> tuple[Any, ...]:
    """What is another object when something was added to the scene."""
    return (scene.instance_bundle, scene.positions, scene.rotations, scene.scales, *scene.tables)


# Renderers of scenes and bundles, and bundles' gaussians, as long as those live.
_renderers: weakref.WeakKeyDictionary[Scene | Bundle, Renderer] = weakref.WeakKeyDictionary()
_rows: weakref.WeakKeyDictionary[Bundle, tuple[int, tuple[Any, ...]]] = weakref.WeakKeyDictionary()


def _renderer_of(subject: Scene | Bundle | Gaussians) -> Renderer:
    if isinstance(subject, Gaussians):
        return Renderer(subject)
    known = _renderers.get(subject)
    if known is None or (isinstance(subject, Scene) and not known._draws(subject)):
        known = _renderers[subject] = Renderer(subject)
    return known


def _rows_of_bundle(bundle: Bundle) -> tuple[Any, ...]:
    device = _device.current_device()
    if bundle not in _rows or _rows[bundle][0] != device:
        _rows[bundle] = (device, _rows_on_device(bundle.gaussians))
    return _rows[bundle][1]


def _rows_on_device(gaussians: Gaussians) -> tuple[Any, ...]:
    """The five arrays as the core wants them on torch's current CUDA device."""
    import torch

    return tuple(_device.aligned(row.detach().to(torch.float32)) for row in rows_of(gaussians.torch("cuda")))


def _empty(shape: tuple[int, ...]) -> Any:
    """A float32 tensor on torch's current CUDA device, not initialised."""
    import torch

    return torch.empty(shape, dtype=torch.float32, device="cuda")


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
