"""Draw scenes, bundles and assets: select a cut, then project, bin and blend it."""

from __future__ import annotations

import atexit
import time
import weakref
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, overload

from v3dg import _core, _device, _resident
from v3dg.bundle import Bundle
from v3dg.cameras import Camera
from v3dg.false_color import ColorBy, false_color
from v3dg.gaussians import Gaussians
from v3dg.rasterize import intrinsics, rows_of, view_of_world
from v3dg.scene import Scene
from v3dg.select import Selection, camera_of, over_budget, rule_of, select

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence


@dataclass(frozen=True)
class Stats:
    """What a picture cost.

    Attributes:
        gaussians_selected: Gaussians of the selected clusters.
        gaussians_in_frustum: Of them, those in front of the near plane whose extent meets the image, before
            any finer cull.
        tolerance: px² that one gaussian of a coarser cluster stands for at most; with a budget, those that it
            came to; 0 for an asset.
        select_ms: Time to choose the clusters.
        draw_ms: Time to draw them.
    """

    gaussians_selected: int
    gaussians_in_frustum: int
    tolerance: float
    select_ms: float
    draw_ms: float


class Image:
    """A picture of H x W pixels: NumPy arrays, or torch tensors on the CUDA device that drew it.

    A picture drawn by CUDA may still be under way; to look at one of its attributes waits until it is there,
    and raises what went wrong.

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


@overload
def render(
    subject: Scene | Bundle | Gaussians,
    camera: Camera,
    *,
    tolerance: float | None = ...,
    budget: int | None = ...,
    min_level: int = ...,
    cut: Selection | None = ...,
    color_by: ColorBy = ...,
    background: Sequence[float] = ...,
    device: str = ...,
) -> Image: ...
@overload
def render(
    subject: Scene | Bundle | Gaussians,
    camera: Sequence[Camera],
    *,
    tolerance: float | None = ...,
    budget: int | None = ...,
    min_level: int = ...,
    cut: Selection | None = ...,
    color_by: ColorBy = ...,
    background: Sequence[float] = ...,
    device: str = ...,
) -> list[Image]: ...
def render(
    subject: Scene | Bundle | Gaussians,
    camera: Camera | Sequence[Camera],
    *,
    tolerance: float | None = None,
    budget: int | None = None,
    min_level: int = 0,
    cut: Selection | None = None,
    color_by: ColorBy = "appearance",
    background: Sequence[float] = (0.0, 0.0, 0.0),
    device: str = "cpu",
) -> Image | list[Image]:
    """Draw a scene, one bundle or one asset, for one camera or for several.

    Clusters whose gaussians each stand for at most `tolerance` px² are drawn in place of finer ones; level 0
    with the asset's own filter, coarser levels with the filter they were made for (V3DG, section 3.4; our
    metric is in docs/levels.md). An asset is drawn whole, without a filter.

    Args:
        subject: What to draw, in world space.
        camera: Pinhole camera. With several, each has its own cut and its own picture, as if drawn alone.
        tolerance: px² of screen per gaussian; 0 draws level 0 everywhere. `DEFAULT_TOLERANCE` if None; with a
            budget, 0.
        budget: Most gaussians to draw in one picture, as in `v3dg.select`.
        min_level: No finer level is drawn, except where an asset has no coarser one.
        cut: Draw what was selected before from this scene, whatever the camera: a cut to walk around. Takes
            the place of `tolerance`, `budget` and `min_level`.
        color_by: "level" or "cluster" colours gaussians by the one that they belong to.
        background: Three numbers.
        device: "cpu", "cuda" or "auto"; CUDA draws on torch's current stream and keeps on the device what the
            next picture of the same scene or bundle needs. Use a `Renderer` to say how long.

    Raises:
        ValueError: An argument is not as above, or the coarsest cut has more gaussians than the budget; on
            CUDA that is raised where the picture is looked at.
        RuntimeError: `device` is "cuda" and something is missing for it.
    """
    drawer = _drawer_of(subject, color_by) if _device.resolve(device) == "cuda" else None

    def one(view: Camera) -> Image:
        options = {"tolerance": tolerance, "budget": budget, "min_level": min_level, "cut": cut}
        if drawer is not None:
            return drawer.draw(subject, view, background, **options)
        return _render_on_cpu(subject, view, background, color_by, **options)

    return one(camera) if isinstance(camera, Camera) else [one(view) for view in camera]


def _render_on_cpu(
    subject: Scene | Bundle | Gaussians,
    camera: Camera,
    background: Sequence[float],
    color_by: ColorBy,
    **options: Any,
) -> Image:
    shade = _three(background)
    if isinstance(subject, Gaussians):
        _check_asset(color_by, **options)
        start = time.perf_counter()
        lens = (intrinsics(camera), camera.width, camera.height, shade, True)
        model = _core.Model(*rows_of(subject.numpy()))
        color, alpha, depth, counts, _ = _core.rasterize(
            model, view_of_world(camera), 0.0, False, *lens, False
        )
        milliseconds = 1e3 * (time.perf_counter() - start)
        asset_stats = Stats(len(subject), counts["in_frustum"], 0.0, 0.0, milliseconds)
        return Image(color, alpha, depth, lambda: asset_stats)

    scene = Scene.of(subject)
    tables = cluster_tables(scene, color_by)
    start = time.perf_counter()
    cut = options.pop("cut")
    selection = select(scene, camera, **options) if cut is None else _checked(cut, subject, **options)
    selected = time.perf_counter()
    color, alpha, depth, counts = _core.render_selection(
        tables,
        _resident.instances_on_host(scene),
        camera_of(camera),
        selection.instance_ids,
        selection.cluster_ids,
        shade,
        True,
    )
    drawn = time.perf_counter()
    stats = Stats(
        gaussians_selected=selection.num_gaussians,
        gaussians_in_frustum=counts["in_frustum"],
        tolerance=selection.tolerance,
        select_ms=1e3 * (selected - start),
        draw_ms=1e3 * (drawn - selected),
    )
    return Image(color, alpha, depth, lambda: stats)


class Renderer:
    """Draws one scene, bundle or asset on torch's current CUDA device, with what that needs.

    Enqueuing a picture waits for nothing, so pictures can be drawn ahead, and captured in a CUDA graph: draw
    once what the graph will meet, so that it is all on the device, then capture `render`; what was not drawn
    before is a RuntimeError. Keep the renderer as long as the graph, and capture again when the scene has
    changed. A picture that is under way when its scene is changed is finished first.

    Args:
        color_by: As in `v3dg.render`.

    Raises:
        RuntimeError: Something is missing for CUDA.
    """

    def __init__(self, subject: Scene | Bundle | Gaussians, *, color_by: ColorBy = "appearance") -> None:
        _device.resolve("cuda")
        self._subject = subject
        self._drawer = _Drawer(subject, color_by)

    def render(
        self,
        camera: Camera,
        *,
        tolerance: float | None = None,
        budget: int | None = None,
        min_level: int = 0,
        cut: Selection | None = None,
        background: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> Image:
        """Draw on torch's current stream, as `v3dg.render` does."""
        options = {"tolerance": tolerance, "budget": budget, "min_level": min_level, "cut": cut}
        return self._drawer.draw(self._subject, camera, background, **options)


class _Drawer:
    """What of a renderer does not keep its subject alive."""

    def __init__(self, subject: Scene | Bundle | Gaussians, color_by: ColorBy) -> None:
        self.device = _device.current_device()
        self._color_by = color_by
        self._num_bundles = 0
        if isinstance(subject, Gaussians):
            _check_asset(color_by)
            self._frame: Any = _core.ModelFrame(_rows_on_device(subject), _device.current_stream())
        else:
            self._take_bundles(Scene.of(subject).bundles)

    def _take_bundles(self, bundles: Sequence[Bundle]) -> None:
        rows = [_rows_of_bundle(bundle, self._color_by) for bundle in bundles]
        self._frame = _core.SceneFrame(rows, _device.current_stream())
        self._num_bundles = len(bundles)

    def draw(
        self, subject: Scene | Bundle | Gaussians, camera: Camera, background: Sequence[float], **options: Any
    ) -> Image:
        shape = (camera.height, camera.width)
        shade, stream = _three(background), _device.current_stream()
        if isinstance(subject, Gaussians):
            _check_asset(self._color_by, **options)
            picture = (_empty((*shape, 3)), _empty(shape), _empty(shape))
            drawing = self._frame.draw(
                view_of_world(camera), 0.0, False, intrinsics(camera), shade, picture, stream
            )
            return Image(*picture, lambda: _stats(drawing.finish(), 0.0))

        cut, budget = options.pop("cut"), options["budget"]
        rule = rule_of(**options, footprint="solid_angle", cull=True)
        if isinstance(subject, Scene) and self._num_bundles != len(subject.bundles):
            self._take_bundles(subject.bundles)
        resident = _resident.resident_of(subject)
        scene = resident.core
        picture = (_empty((*shape, 3)), _empty(shape), _empty(shape))
        if cut is None:
            drawing = self._frame.draw(scene, camera_of(camera), rule, shade, picture, stream)
        else:
            selection = _checked(cut, subject, **options)
            pairs = (_uploaded(selection.instance_ids), _uploaded(selection.cluster_ids))
            drawing = self._frame.draw_cut(scene, camera_of(camera), *pairs, shade, picture, stream)
        resident.add_drawing(drawing)

        def finish() -> Stats:
            counts = drawing.finish()
            if budget is not None and counts["exceeds_budget"]:
                raise over_budget(budget, counts["least"])
            used = (
                cut.tolerance if cut is not None else counts["tolerance"] if budget is not None else rule[0]
            )
            return _stats(counts, used)

        return Image(*picture, finish)


def _stats(counts: dict[str, Any], tolerance: float) -> Stats:
    return Stats(counts["gaussians"], counts["in_frustum"], tolerance, counts["select_ms"], counts["draw_ms"])


def _three(background: Sequence[float]) -> list[float]:
    if len(background) != 3:
        raise ValueError(f"background: expected three numbers, got {len(background)}")
    return [float(b) for b in background]


def _check_asset(color_by: ColorBy, **options: Any) -> None:
    """An asset has no levels: refuse what asks for them."""
    for name, value in options.items():
        if name != "tolerance" and value:
            raise ValueError(f"{name}: expected a scene or a bundle to choose from, got an asset")
    if color_by != "appearance":
        raise ValueError(
            f"color_by: expected 'appearance' for an asset, which has no levels, got {color_by!r}"
        )
    rule_of(options.get("tolerance"), None, 0, "solid_angle", True)


def _checked(cut: Selection, subject: Scene | Bundle, **options: Any) -> Selection:
    """The cut, if it is one of this scene and nothing else is asked for."""
    for name, value in options.items():
        if value:
            raise ValueError(f"{name}: expected nothing beside a cut, which has been chosen, got {value}")
    mine = cut.scene is subject or (isinstance(subject, Bundle) and cut.scene.bundles == [subject])
    if not mine:
        raise ValueError("cut: expected a selection from this scene, got one from another")
    if (cut.instance_ids >= len(cut.scene)).any():
        raise ValueError("cut: expected instances of the scene, got some that were removed since")
    return cut


# Drawers of scenes and bundles, and bundles' gaussians, as long as those live.
_drawers: weakref.WeakKeyDictionary[Scene | Bundle, dict[str, _Drawer]] = weakref.WeakKeyDictionary()
_rows: weakref.WeakKeyDictionary[Bundle, dict[str, tuple[int, tuple[Any, ...]]]] = weakref.WeakKeyDictionary()

atexit.register(_drawers.clear)  # while the driver is there


def _drawer_of(subject: Scene | Bundle | Gaussians, color_by: ColorBy) -> _Drawer:
    if isinstance(subject, Gaussians):
        return _Drawer(subject, color_by)
    known = _drawers.setdefault(subject, {})
    if color_by not in known or known[color_by].device != _device.current_device():
        known[color_by] = _Drawer(subject, color_by)
    return known[color_by]


def _rows_of_bundle(bundle: Bundle, color_by: ColorBy) -> tuple[Any, ...]:
    device, known = _device.current_device(), _rows.setdefault(bundle, {})
    if color_by not in known or known[color_by][0] != device:
        known[color_by] = (device, _rows_on_device(false_color(bundle, color_by)))
    return known[color_by][1]


def _rows_on_device(gaussians: Gaussians) -> tuple[Any, ...]:
    """The five arrays as the core wants them on torch's current CUDA device."""
    import torch

    return tuple(_device.aligned(row.detach().to(torch.float32)) for row in rows_of(gaussians.torch("cuda")))


def _empty(shape: tuple[int, ...]) -> Any:
    """A float32 tensor on torch's current CUDA device, not initialised."""
    import torch

    return torch.empty(shape, dtype=torch.float32, device="cuda")


def _uploaded(array: Any) -> Any:
    import torch

    return torch.from_numpy(array).to("cuda")


# A bundle's gaussians as the core lays them out, made when it is first drawn.
_models: weakref.WeakKeyDictionary[Bundle, dict[str, Any]] = weakref.WeakKeyDictionary()


def cluster_tables(scene: Scene, color_by: ColorBy = "appearance") -> list[tuple[Any, ...]]:
    """Gaussians and clusters of the scene's bundles as the CPU's half takes them."""
    return [_table(bundle, color_by) for bundle in scene.bundles]


def _table(bundle: Bundle, color_by: ColorBy) -> tuple[Any, ...]:
    known = _models.setdefault(bundle, {})
    if color_by not in known:
        known[color_by] = _core.Model(*rows_of(false_color(bundle, color_by)))
    clusters = bundle.clusters
    return known[color_by], clusters.offset, clusters.filter_px2, clusters.antialiased
