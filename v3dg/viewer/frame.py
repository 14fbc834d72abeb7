"""One picture of the viewer: a scene, a view and settings become pixels and figures."""

import threading
import time
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import numpy as np
import numpy.typing as npt

from v3dg import _core, _device
from v3dg._device import CPU, Device
from v3dg._urls import beside, cleaned, shown
from v3dg.build import BuildConfig, build_bundle
from v3dg.cameras import Camera
from v3dg.cleaning import ball_of_most
from v3dg.false_color import ColorBy
from v3dg.gaussians import Gaussians
from v3dg.image import RenderedImage, Stats
from v3dg.pick import Pick, pick
from v3dg.pictures import to_8bit
from v3dg.pool import PoolLook, chosen_bytes
from v3dg.render import CutRequest, Renderer, render, shade_of
from v3dg.residency import residency
from v3dg.scene import Scene, Subject
from v3dg.select import DEFAULT_FADE, DEFAULT_TOLERANCE, Selection, rule_of, select, select_by
from v3dg.viewer.view import View

Pixels: TypeAlias = npt.NDArray[np.uint8]
Window: TypeAlias = tuple[int, int, int, int]

Shows: TypeAlias = Literal[
    "appearance", "level", "cluster", "error", "residency", "depth", "alpha", "count", "difference"
]

# Gaussians in a pixel that get the brightest colour.
MOST_COUNTED = 256
_OF_POOLS_ON_CUDA: tuple[Shows, ...] = ("appearance", "depth", "alpha")
_OF_CUT = ("level", "cluster", "residency", "error", "count")  # colours of clusters, and what is not colours
# So many gaussians are drawn whole while the camera moves, too.
_FEW_GAUSSIANS = 500_000
_SHADE = shade_of((0.0, 0.0, 0.0), None, is_asset=False, depth=True)


@dataclass(frozen=True)
class Settings:
    """What a picture shows, and how finely.

    Attributes:
        shows: The colours, those of a level or a cluster, the error, which is the screen area that a gaussian
            of a coarser cluster stands for, expected depth, alpha, how many gaussians a pixel is blended of,
            or the difference to the picture of all gaussians.
        tolerance, budget, min_level, fade: As in `v3dg.render`, but that a tolerance is always given.
        gain: What a difference is multiplied by.
        split: Share of the width, from the left, that shows all gaussians; 0 for none.
        frozen: The view that the cut is chosen for; None for the one that is looked from.
    """

    shows: Shows = "appearance"
    tolerance: float = DEFAULT_TOLERANCE
    budget: int | None = None
    min_level: int = 0
    fade: float | None = DEFAULT_FADE
    gain: float = 5.0
    split: float = 0.0
    frozen: View | None = None


@dataclass(frozen=True)
class Frame:
    """A picture.

    Attributes:
        pixels: (H, W, 3).
        figures: What it cost; times are those of the whole picture, all else is the cut's.
        shows: As in its settings.
        value_range: The values of the darkest and the brightest colour, where colours are values.
        view: From where it is seen.
        distance: How deep what is in its middle mostly is, world units; None where nothing is, or not known.
    """

    pixels: Pixels
    figures: Stats
    shows: Shows
    value_range: tuple[float, float] | None
    view: View
    distance: float | None = None

    @property
    def size(self) -> tuple[int, int]:
        return self.pixels.shape[1], self.pixels.shape[0]


class _Asked(NamedTuple):
    """How a picture is drawn: `chooser` is whose cut it is, None the camera's; `edge` where it is split."""

    camera: Camera
    chooser: Camera | None
    edge: int
    settings: Settings
    stop: _core.Stop | None
    steps: _core.BudgetSteps | None


class Stopped(Exception):
    """A picture was given up because another one is wanted."""


class SceneView:
    """Draws pictures of one scene, for any number of threads.

    Args:
        subject: A scene, a bundle, or an asset, which is split into clusters but gets no coarser levels.
        device: Where to draw: "cpu", "cuda", or "auto", which is CUDA where that works.
        memory: As in `v3dg.Renderer`. With a pool, one picture is drawn at a time, and what is compared
            with is the finest that it has room for, of the cut's camera; on CUDA nothing is.

    Attributes:
        scene: The subject as a scene.
        near: As in `v3dg.Camera`, to suit the scene's size.
        center, radius: A ball that holds nearly all of it, world units.
        pool: What draws where not all is resident, or None.
    """

    def __init__(
        self, subject: Subject, *, device: str | Device = "auto", memory: int | str | None = "auto"
    ) -> None:
        if isinstance(subject, Gaussians):
            only_leaves = BuildConfig.leaves_only()
            subject = build_bundle(subject, config=only_leaves, device="cpu", progress=False)
        self.scene = Scene.of(subject)
        self.device = _device.resolve(device)
        if memory == "auto":
            memory = chosen_bytes(self.scene.bundles, self.device)
        self.pool = None if memory is None else Renderer(self.scene, device=self.device, memory=memory)
        self._drawing = threading.Lock()
        self.center, self.radius = _bounds(self.scene)
        self.near = min(0.01, 1e-3 * self.radius)
        self.num_levels = max((bundle.num_levels for bundle in self.scene.bundles), default=1)
        sizes = [bundle.clusters.offset[bundle.level_range(0).stop] for bundle in self.scene.bundles]
        self.num_gaussians = int(np.array(sizes, np.int64)[self.scene.instance_bundle].sum())

    @property
    def draws_all_while_moving(self) -> bool:
        """Whether all gaussians are few enough to be drawn in every picture."""
        return self.device.is_cuda or self.num_gaussians <= _FEW_GAUSSIANS

    def explain(self, error: Exception) -> str:
        """Return an error's line, in which bundles go by names, not paths: the tab may be somebody else's."""
        text = " ".join(str(error).split())
        for path in (bundle.path for bundle in self.scene.bundles):
            if path:
                name = beside(path).name
                text = text.replace(path, name).replace(shown(path), name)
        return cleaned(text)

    @property
    def modes(self) -> tuple[Shows, ...]:
        """What can be shown."""
        if self.pool is not None and self.device.is_cuda:
            return _OF_POOLS_ON_CUDA
        return tuple(mode for mode in get_args(Shows) if self.pool is not None or mode != "residency")

    @property
    def shows_cuts(self) -> bool:
        """Whether cuts can be frozen, split and picked from: a pool on CUDA draws its own as they are."""
        return self.pool is None or not self.device.is_cuda

    def frame(
        self,
        view: View,
        size: tuple[int, int],
        settings: Settings,
        stop: _core.Stop | None = None,
        steps: _core.BudgetSteps | None = None,
        patience: float = 0.0,
    ) -> Frame:
        """Draw a picture of ``size`` (width, height) px; with ``steps``, one that follows others.

        It waits so many seconds for pages that a pool lacks.

        Raises:
            Stopped: ``stop`` was requested; it is raised soon after.
            ValueError: The budget is too small for any cut, or a page that a pool lacks is damaged.
        """
        _check(stop)
        if self.pool is not None and self.device.is_cuda:  # which a link may not know
            shows = settings.shows if settings.shows in self.modes else "appearance"
            settings = replace(settings, shows=shows, split=0.0, frozen=None)
        camera = view.camera(*size, self.near)
        chooser = None if settings.frozen is None else settings.frozen.camera(*size, self.near)
        start = 1e3 * time.perf_counter()
        edge = round(settings.split * size[0])
        asked = _Asked(camera, chooser, edge, settings, stop, steps)
        if self.pool is None:
            drawn = self._of_all(asked)
        else:
            with self._drawing:
                drawn = self._of_pool(asked, self.pool, patience)
        picture = np.zeros((size[1], size[0], 3), np.float32)
        colors, value_range, distance = _painted(drawn, settings)
        picture[:, -colors.shape[1] :] = colors
        if edge > 0:
            picture[:, :edge] = drawn.whole[:, :edge]
            picture[:, max(edge - 1, 0) : edge + 1] = 1.0
        figures = drawn.figures._replace(draw_ms=1e3 * time.perf_counter() - start - drawn.figures.select_ms)
        return Frame(to_8bit(picture), figures, settings.shows, value_range, view, distance)

    def pick(self, view: View, size: tuple[int, int], x: int, y: int, settings: Settings) -> Pick | None:
        """Return what a pixel of a picture shows most of, of what is resident where there is a pool."""
        cut: Any = {name: getattr(settings, name) for name in ("tolerance", "budget", "min_level")}
        camera = view.camera(*size, self.near)
        with self._drawing:
            return pick(self.scene, camera, x, y, **cut, renderer=self.pool)

    def _of_pool(self, asked: _Asked, pool: Renderer, patience: float) -> "_Drawn":
        """What a pool has; compared with the finest that it has room for, from whose pages both are drawn."""
        settings = asked.settings
        stop = asked.stop
        edge = asked.edge
        chooser = asked.chooser
        frame = pool.pool_frame
        assert frame is not None
        wanted = CutRequest(settings.tolerance, settings.budget, settings.min_level, settings.fade)
        finest = CutRequest(tolerance=0.0)
        compares = edge > 0 or settings.shows == "difference"
        if patience:
            settled = finest if compares else wanted
            frame.settle(self.scene, chooser or asked.camera, settled, seconds=patience)

        def draw(steps: _core.BudgetSteps | None, look: PoolLook, request: CutRequest) -> RenderedImage:
            image = frame.draw(self.scene, asked.camera, request, _SHADE, steps=steps, stop=stop, look=look)
            assert isinstance(image, RenderedImage)
            _check(stop)
            return image

        finer = draw(None, PoolLook(chooser=chooser), finest) if compares else None
        by: Any = settings.shows if settings.shows in _OF_CUT else "appearance"
        image = draw(asked.steps, PoolLook(by, chooser, aside=compares), wanted)
        first = min(edge, asked.camera.width - 1)
        planes = (image.color, image.alpha, image.depth)
        color, alpha, depth = (_device.to_host(plane)[:, first:] for plane in planes)
        levels = image.stats.levels and (*image.stats.levels, *[0] * self.num_levels)[: self.num_levels]
        whole = None if finer is None else finer.color
        return _Drawn(color, alpha, depth, whole, image.stats._replace(levels=levels))

    def _of_all(self, asked: _Asked) -> "_Drawn":
        """What is resident, which is all; compared with all gaussians."""
        camera, settings, stop, edge = asked.camera, asked.settings, asked.stop, asked.edge
        rule = rule_of(settings.tolerance, settings.budget, settings.min_level, fade=settings.fade)
        cut = select_by(rule, self.scene, asked.chooser or camera, settings.budget, self.device, asked.steps)
        first, shows = min(edge, camera.width - 1), settings.shows
        window = first, 0, camera.width, camera.height
        if shows in ("count", "error"):
            how: Any = _core.SceneFrame.count_cut if shows == "count" else _core.SceneFrame.draw_metrics
            rules = [rule_of(cut.tolerance, None, 0)] if shows == "error" else []
            planes = self._values(how, cut, camera, window, stop, "appearance", *rules)
        else:
            by: Any = shows if shows in _OF_CUT else "appearance"
            planes = self._draw(cut, camera, window, by, stop)
        whole, last = None, camera.width if shows == "difference" else edge
        if last > 0:
            finest = select(self.scene, camera, tolerance=0.0, device=self.device)
            whole = self._draw(finest, camera, (0, 0, last, camera.height), "appearance", stop)[0]
        cost = cut.num_gaussians, planes[3], cut.tolerance, 1e3 * cut.seconds, 0.0
        level, size = cut._per_pair(lambda c: c.level), cut._per_pair(lambda c: np.diff(c.offset))
        levels = np.bincount(level, size, self.num_levels).astype(int).tolist()
        return _Drawn(*planes[:3], whole, Stats(*cost, tuple(levels)))

    def _draw(
        self, cut: Selection, camera: Camera, window: Window, color_by: ColorBy, stop: _core.Stop | None
    ) -> tuple[Any, Any, Any, int]:
        """Colour, alpha and depth of the window, and the gaussians in the frustum of the whole picture."""
        if not self.device.is_cuda:
            return self._values(_core.SceneFrame.draw_cut, cut, camera, window, stop, color_by)
        how: Any = {"color_by": color_by, "depth": True, "device": self.device, "memory": None}
        image = render(self.scene, camera, cut=cut, **how)
        x0, y0, x1, y1 = window
        planes = (_device.to_host(plane) for plane in (image.color, image.alpha, image.depth))
        color, alpha, depth = (plane[y0:y1, x0:x1] for plane in planes)
        return color, alpha, depth, image.stats.gaussians_in_frustum

    def _values(
        self, how: Any, cut: Selection, camera: Camera, window: Window, stop: Any, by: ColorBy, *rule: Any
    ) -> tuple[Any, Any, Any, int]:
        """As `_draw`, by a method of frames that are drawn on the CPU on any device."""
        frame, resident = _core.SceneFrame(CPU.number), residency.scene(self.scene, CPU)
        cut.check(resident.revision)  # it still has the instances of the cut
        residency.set_models(frame, resident.bundles, CPU, by)
        pairs, part = (cut.instance_ids, cut.cluster_ids), camera.core.window(*window)
        drawing = how(frame, resident.core, part, *rule, *pairs, _SHADE, stop, cut.given_weights)
        _check(stop)
        return drawing.color, drawing.alpha, drawing.depth, drawing.finish().in_frustum


class _Drawn(NamedTuple):
    """Planes of what is right of the split, what it is compared with from the left on, and what it cost."""

    color: Any
    alpha: Any
    depth: Any  # or how many gaussians a pixel is blended of
    whole: Any
    figures: Stats


def _painted(drawn: _Drawn, settings: Settings) -> tuple[Any, tuple[float, float] | None, float | None]:
    """Colours right of the split, values of darkest and brightest, the distance."""
    shows, alpha, depth = settings.shows, drawn.alpha, drawn.depth
    if shows == "count":
        values = np.log2(np.maximum(depth, 1)) / np.log2(MOST_COUNTED)
        return _core.ramp(values) * (depth > 0)[..., None], (1.0, MOST_COUNTED), None
    middle = tuple(slice(side * 3 // 8, side * 5 // 8 + 1) for side in alpha.shape)
    covered = depth[middle][alpha[middle] > 0.5]
    distance = float(np.median(covered)) if covered.size else None
    if shows == "error":
        mean = np.clip(drawn.color[..., 0] / np.maximum(alpha, 1e-6), 0, 1)
        return _core.ramp(mean) * alpha[..., None], (0.0, drawn.figures.tolerance), distance
    if shows == "alpha":
        return np.repeat(alpha[..., None], 3, axis=2), (0.0, 1.0), distance
    if shows == "depth":
        covered = depth[alpha > 0.5]
        # A few gaussians far from all others would take all the colours.
        near, far = np.percentile(covered, (1, 99)) if covered.size else (0.0, 1.0)
        values = np.clip((far - depth) / max(far - near, 1e-12), 0, 1)
        return _core.ramp(values) * alpha[..., None], (float(far), float(near)), distance
    if shows == "difference":
        difference = np.abs(drawn.color - drawn.whole[:, -alpha.shape[1] :])
        return np.minimum(settings.gain * difference, np.float32(1)), None, distance
    return drawn.color, None, distance


def _check(stop: _core.Stop | None) -> None:
    if stop is not None and stop.is_requested:
        raise Stopped("it was stopped")


def _bounds(scene: Scene) -> tuple[Any, float]:
    """Centre and radius of a ball around nearly all of the scene: trained assets have a few far outliers."""
    corners = [np.zeros((0, 3))]
    for b, bundle in enumerate(scene.bundles):
        mine = scene.instance_bundle == b
        leaves = bundle.clusters.box[: bundle.level_range(0).stop].reshape(-1, 3)
        if not len(leaves):
            continue
        low, high = np.percentile(leaves.astype(np.float64), (2, 98), axis=0)
        box = np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=-1).reshape(-1, 3)
        turned = np.einsum("i,iab,kb->ika", scene.scales[mine], scene.rotations[mine], box)
        corners.append((turned + scene.positions[mine, None]).reshape(-1, 3))
    points = np.concatenate(corners)
    return ball_of_most(points) if len(points) else (np.zeros(3), 1.0)
