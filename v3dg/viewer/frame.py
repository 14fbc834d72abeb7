"""Draws one picture for the viewer. It computes pixels and statistics from a scene, a
view and settings."""

import functools
import threading
import time
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, TypeAlias, get_args

import numpy as np
import numpy.typing as npt

from v3dg import _core, _device
from v3dg._device import CPU, Device
from v3dg._numbers import Floats
from v3dg._urls import beside, cleaned, shown
from v3dg.cameras import Camera, VectorLike
from v3dg.cleaning import ball_of_most
from v3dg.false_color import ColorBy
from v3dg.framing import Framing, frame_subject
from v3dg.gaussians import Gaussians
from v3dg.image import RenderedImage, Stats
from v3dg.levels import BuildConfig, build_bundle
from v3dg.pick import Pick, pick
from v3dg.pictures import to_8bit
from v3dg.pool import chosen_bytes
from v3dg.render import CutRequest, FrameRequest, Look, Renderer, render, shade_of
from v3dg.residency import residency
from v3dg.scene import Scene, Subject
from v3dg.select import DEFAULT_FADE, DEFAULT_TOLERANCE, Selection, rule_of, select, select_by
from v3dg.viewer.view import View

Pixels: TypeAlias = npt.NDArray[np.uint8]
Window: TypeAlias = tuple[int, int, int, int]
_Float32: TypeAlias = npt.NDArray[np.float32]

Shows: TypeAlias = Literal[
    "appearance", "level", "cluster", "error", "residency", "depth", "alpha", "count", "difference"
]

# The brightest colour stands for at least this number of gaussians in a pixel.
MOST_COUNTED = 256
_MODES_OF_POOLS_ON_CUDA: tuple[Shows, ...] = ("appearance", "depth", "alpha")
# If there are at most this many gaussians, all of them are drawn even while the camera
# moves.
_FEW_GAUSSIANS = 500_000
# Height in px of the picture for which a first view is computed. Only the aspect ratio
# matters.
_FIRST_PIXELS = 1000
_SHADE = shade_of((0.0, 0.0, 0.0), None, is_asset=False, depth=True)


@dataclass(frozen=True)
class Settings:
    """The content and quality of a picture.

    Attributes:
        shows: The display mode. It is one of the gaussians' own colours; the colours of
            levels, clusters or missing pages; the error, which is the screen area per
            gaussian of a coarser cluster; expected depth; alpha; the number of
            gaussians that a pixel blends; and the difference from the picture of all
            gaussians.
        tolerance, budget, min_level, fade: As in `v3dg.render`, but the tolerance is
            never None.
        gain: Factor by which differences are multiplied.
        split: The left part of the picture that shows all gaussians, as a fraction of
            its width. 0 means no split.
        frozen: The view for which the cut is selected; None for the view of the
            picture.
        background: Red, green and blue, 0 to 1, behind the gaussians. Modes whose
            colours represent values are drawn on black.
    """

    shows: Shows = "appearance"
    tolerance: float = DEFAULT_TOLERANCE
    budget: int | None = None
    min_level: int = 0
    fade: float | None = DEFAULT_FADE
    gain: float = 5.0
    split: float = 0.0
    frozen: View | None = None
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Frame:
    """A finished picture.

    Attributes:
        pixels: (H, W, 3) uint8.
        figures: Statistics of the cut, except that times are those of the whole
            picture.
        shows: The display mode, as in `Settings`.
        value_range: The values of the darkest and the brightest colour if colours
            represent values.
        view: The viewpoint of the picture.
        distance: Median depth around the middle, in world units. It is None if nothing
            is there, or if it is unknown.
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


class _Job(NamedTuple):
    """A picture to draw.

    Attributes:
        chooser: The camera for which the cut is selected; None for the camera of the
            picture.
        edge: The column in px at which the picture is split.
    """

    camera: Camera
    chooser: Camera | None
    edge: int
    settings: Settings
    stop: _core.Stop | None
    steps: _core.BudgetSteps | None


class _Planes(NamedTuple):
    """The planes of a window of a picture.

    Attributes:
        color: (H, W, 3) premultiplied colour.
        alpha: (H, W) opacity.
        depth: (H, W) expected depth, or the number of gaussians that each pixel blends.
        gaussians_in_frustum: Number of gaussians in the frustum.
    """

    color: _Float32
    alpha: _Float32
    depth: _Float32
    gaussians_in_frustum: int


class _Drawn(NamedTuple):
    """The input of `_paint`.

    Attributes:
        color, alpha, depth: As in `_Planes`, for the part to the right of the split.
        whole: The picture of all gaussians for comparison, from the left edge to the
            split or to the right edge. It is None without a comparison.
        figures: The statistics of drawing.
    """

    color: _Float32
    alpha: _Float32
    depth: _Float32
    whole: _Float32 | None
    figures: Stats


class _Painting(NamedTuple):
    """The colours of the part to the right of the split. The other fields are as in
    `Frame`."""

    colors: _Float32
    value_range: tuple[float, float] | None
    distance: float | None


class Stopped(Exception):
    """Raised when a picture is abandoned because another one was requested."""


class SceneView:
    """Draws pictures of one scene. Several threads may use it.

    Args:
        subject: A scene, a bundle, or an asset. An asset is divided into clusters,
            without coarser levels.
        device: The device that draws: "cpu", "cuda", or "auto", which means CUDA if it
            can be used.
        memory: As in `v3dg.Renderer`. With a pool, one picture is drawn at a time.
            Pictures are then compared with the finest cut that fits into the pool,
            selected for the same camera. With a pool on CUDA, comparisons are not
            available.

    Attributes:
        scene: The subject as a scene.
        near: Depth of the near plane, chosen by the size of the scene, in world units.
        center, radius: A ball that contains nearly all of the scene, in world units.
        pool: The renderer with a pool; None if everything is resident.
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
        self.pool: Renderer | None = None
        if memory is not None:
            self.pool = Renderer(self.scene, device=self.device, memory=memory)
        self._drawing = threading.Lock()
        self.center, self.radius = _bounds(self.scene)
        self.near = min(0.01, 1e-3 * self.radius)
        self.num_levels = max((bundle.num_levels for bundle in self.scene.bundles), default=1)
        sizes = [bundle.num_leaves for bundle in self.scene.bundles]
        self.num_gaussians = int(np.array(sizes, np.int64)[self.scene.instance_bundle].sum())

    @functools.cached_property
    def framing(self) -> Framing:
        """The framing of the scene, which determines the first views."""
        return frame_subject(self.scene)

    def first_view(self, up: VectorLike, aspect: float) -> tuple[View, Floats]:
        """Return the first view of a tab, and the (3,) point that its camera orbits."""
        height = _FIRST_PIXELS
        camera = self.framing.camera(up, max(round(aspect * height), 1), height)
        return replace(View.of_camera(camera), aspect=aspect), self.framing.focus(camera)

    @property
    def draws_all_while_moving(self) -> bool:
        """Whether drawing all gaussians is so fast that every picture shows all of
        them."""
        return self.device.is_cuda or self.num_gaussians <= _FEW_GAUSSIANS

    def explain(self, error: Exception) -> str:
        """Return a line of text about an error. It contains the names of bundles, but
        not their paths, because the tab may belong to another user."""
        text = " ".join(str(error).split())
        for path in (bundle.path for bundle in self.scene.bundles):
            if path:
                name = beside(path).name
                text = text.replace(path, name).replace(shown(path), name)
        return cleaned(text)

    @property
    def modes(self) -> tuple[Shows, ...]:
        """The available display modes."""
        if self.pool is not None and self.device.is_cuda:
            return _MODES_OF_POOLS_ON_CUDA
        return tuple(
            mode for mode in get_args(Shows) if self.pool is not None or mode != "residency"
        )

    @property
    def shows_cuts(self) -> bool:
        """Whether freezing, splitting and picking are available. A pool on CUDA can
        only draw its own cut."""
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
        """Draw a picture of ``size`` (width, height) px. ``steps`` is the pacing state
        of a sequence of pictures, or None for a single one.

        Drawing waits up to ``patience`` seconds for missing pages of a pool.

        Raises:
            Stopped: ``stop`` was requested. Drawing ends soon after that.
            ValueError: The budget is too small for any cut, or a page that the picture
                needs is damaged.
        """
        _check(stop)
        # Settings from a link may request a mode that is not available.
        if self.pool is not None and self.device.is_cuda:
            shows = settings.shows
            if shows not in self.modes:
                shows = "appearance"
            settings = replace(settings, shows=shows, split=0.0, frozen=None)
        width, height = size
        camera = view.camera(width, height, self.near)
        chooser: Camera | None = None
        if settings.frozen is not None:
            chooser = settings.frozen.camera(width, height, self.near)
        start_ms = 1e3 * time.perf_counter()
        edge = round(settings.split * width)
        job = _Job(camera, chooser, edge, settings, stop, steps)
        if self.pool is None:
            drawn = self._draw_resident(job)
        else:
            with self._drawing:
                drawn = self._draw_pool(job, self.pool, patience)
        picture = np.zeros((height, width, 3), np.float32)
        painting = _paint(drawn, settings)
        picture[:, -painting.colors.shape[1] :] = painting.colors
        if edge > 0:
            assert drawn.whole is not None
            picture[:, :edge] = drawn.whole[:, :edge]
            picture[:, max(edge - 1, 0) : edge + 1] = 1.0
        total_ms = 1e3 * time.perf_counter() - start_ms
        figures = drawn.figures._replace(draw_ms=total_ms - drawn.figures.select_ms)
        pixels = to_8bit(picture)
        return Frame(pixels, figures, settings.shows, painting.value_range, view, painting.distance)

    def pick(
        self, view: View, size: tuple[int, int], x: int, y: int, settings: Settings
    ) -> Pick | None:
        """Return the gaussian with the largest weight in a pixel of a picture. With a
        pool, only resident gaussians are considered."""
        camera = view.camera(*size, self.near)
        with self._drawing:
            return pick(
                self.scene,
                camera,
                x,
                y,
                tolerance=settings.tolerance,
                budget=settings.budget,
                min_level=settings.min_level,
                renderer=self.pool,
            )

    def _draw_pool(self, job: _Job, pool: Renderer, patience: float) -> _Drawn:
        """Draw a picture from a pool and, for a comparison, another one with the finest
        cut that fits into the pool.

        Both are drawn from the pages of the finer cut.
        """
        settings = job.settings
        pool_frame = pool.pool_frame
        assert pool_frame is not None
        request = CutRequest(settings.tolerance, settings.budget, settings.min_level, settings.fade)
        finest = CutRequest(tolerance=0.0)
        compares = job.edge > 0 or settings.shows == "difference"
        if patience:
            settled_request = request
            if compares:
                settled_request = finest
            pool_frame.settle(
                self.scene, job.chooser or job.camera, settled_request, seconds=patience
            )

        def draw(cut: CutRequest, look: Look, steps: _core.BudgetSteps | None) -> RenderedImage:
            frame_request = FrameRequest(job.camera, cut, _SHADE, look=look)
            image = pool_frame.draw(self.scene, frame_request, steps, job.stop)
            assert isinstance(image, RenderedImage)
            _check(job.stop)
            return image

        whole: _Float32 | None = None
        if compares:
            finest_image = draw(finest, Look(chooser=job.chooser), None)
            whole = _on_background(finest_image.color, finest_image.alpha, settings)
        look = Look(_look_of(settings.shows), job.chooser, aside=compares)
        image = draw(request, look, job.steps)
        first = min(job.edge, job.camera.width - 1)
        figures = image.stats
        if figures.levels:
            no_gaussians = [0] * self.num_levels
            levels = (*figures.levels, *no_gaussians)[: self.num_levels]
            figures = figures._replace(levels=levels)
        return _Drawn(
            color=_device.to_host(image.color)[:, first:],
            alpha=_device.to_host(image.alpha)[:, first:],
            depth=_device.to_host(image.depth)[:, first:],
            whole=whole,
            figures=figures,
        )

    def _draw_resident(self, job: _Job) -> _Drawn:
        """Draw a picture when all gaussians are resident and, for a comparison, another
        one with all of them."""
        camera = job.camera
        settings = job.settings
        budget = settings.budget
        rule = rule_of(settings.tolerance, budget, settings.min_level, fade=settings.fade)
        cut = select_by(rule, self.scene, job.chooser or camera, budget, self.device, job.steps)
        first = min(job.edge, camera.width - 1)
        window = (first, 0, camera.width, camera.height)
        planes = self._draw(cut, camera, window, settings.shows, job.stop)
        end_of_whole = job.edge
        if settings.shows == "difference":
            end_of_whole = camera.width
        whole: _Float32 | None = None
        if end_of_whole > 0:
            finest = select(self.scene, camera, tolerance=0.0, device=self.device)
            window = (0, 0, end_of_whole, camera.height)
            finest_planes = self._draw(finest, camera, window, "appearance", job.stop)
            whole = _on_background(finest_planes.color, finest_planes.alpha, settings)
        level = cut.per_pair(lambda clusters: clusters.level)
        size = cut.per_pair(lambda clusters: np.diff(clusters.offset))
        figures = Stats(
            gaussians_selected=cut.num_gaussians,
            gaussians_in_frustum=planes.gaussians_in_frustum,
            tolerance=cut.tolerance,
            select_ms=1e3 * cut.seconds,
            draw_ms=0.0,
            levels=tuple(np.bincount(level, size, self.num_levels).astype(int).tolist()),
        )
        return _Drawn(planes.color, planes.alpha, planes.depth, whole, figures)

    def _draw(
        self, cut: Selection, camera: Camera, window: Window, shows: Shows, stop: _core.Stop | None
    ) -> _Planes:
        """Draw a window of the picture of a cut, on the device or, for modes that only
        the CPU supports, on the CPU."""
        if not self.device.is_cuda or shows in ("count", "error"):
            return self._draw_on_cpu(cut, camera, window, shows, stop)
        image = render(
            self.scene,
            camera,
            cut=cut,
            color_by=_color_by(shows),
            depth=True,
            device=self.device,
            memory=None,
        )
        x0, y0, x1, y1 = window
        return _Planes(
            color=_device.to_host(image.color)[y0:y1, x0:x1],
            alpha=_device.to_host(image.alpha)[y0:y1, x0:x1],
            depth=_device.to_host(image.depth)[y0:y1, x0:x1],
            gaussians_in_frustum=image.stats.gaussians_in_frustum,
        )

    def _draw_on_cpu(
        self, cut: Selection, camera: Camera, window: Window, shows: Shows, stop: _core.Stop | None
    ) -> _Planes:
        frame = _core.SceneFrame(CPU.number)
        resident = residency.scene(self.scene, CPU)
        # Raises an error if instances of the cut were removed.
        cut.check(resident.revision)
        residency.set_models(frame, resident.bundles, CPU, _color_by(shows))
        request = _core.FrameRequest(
            camera.core.window(*window),
            rule_of(cut.tolerance, None, 0),
            _SHADE,
            _core.GivenCut(cut.instance_ids, cut.cluster_ids, cut.given_weights),
            _core.Look(_look_of(shows)),
        )
        drawing = frame.draw(resident.core, request, stop=stop)
        _check(stop)
        assert drawing.depth is not None
        return _Planes(drawing.color, drawing.alpha, drawing.depth, drawing.finish().in_frustum)


def _color_by(shows: Shows) -> ColorBy:
    """Return the colours in which gaussians are drawn. `_paint` computes the other
    modes from these pictures."""
    if shows in ("level", "cluster", "residency"):
        return shows
    return "appearance"


def _look_of(shows: Shows) -> ColorBy | Literal["error", "count"]:
    """Return the mode of `v3dg.render.Look` for drawing a display mode."""
    if shows in ("error", "count"):
        return shows
    return _color_by(shows)


def _paint(drawn: _Drawn, settings: Settings) -> _Painting:
    shows = settings.shows
    alpha = drawn.alpha
    depth = drawn.depth
    if shows == "count":
        values = np.log2(np.maximum(depth, 1)) / np.log2(MOST_COUNTED)
        colors = _core.ramp(values) * (depth > 0)[..., None]
        return _Painting(colors, (1.0, MOST_COUNTED), None)
    distance = _distance_in_middle(alpha, depth)
    if shows == "error":
        mean = np.clip(drawn.color[..., 0] / np.maximum(alpha, 1e-6), 0, 1)
        colors = _core.ramp(mean) * alpha[..., None]
        return _Painting(colors, (0.0, drawn.figures.tolerance), distance)
    if shows == "alpha":
        return _Painting(np.repeat(alpha[..., None], 3, axis=2), (0.0, 1.0), distance)
    if shows == "depth":
        near, far = _depth_range(alpha, depth)
        values = np.clip((far - depth) / max(far - near, 1e-12), 0, 1)
        colors = _core.ramp(values) * alpha[..., None]
        return _Painting(colors, (float(far), float(near)), distance)
    if shows == "difference":
        assert drawn.whole is not None
        colors = _on_background(drawn.color, alpha, settings)
        difference = np.abs(colors - drawn.whole[:, -alpha.shape[1] :])
        return _Painting(np.minimum(settings.gain * difference, np.float32(1)), None, distance)
    return _Painting(_on_background(drawn.color, alpha, settings), None, distance)


def _on_background(color: _Float32, alpha: _Float32, settings: Settings) -> _Float32:
    """Return (H, W, 3) the premultiplied colours over the background."""
    colors = np.asarray(_device.to_host(color))
    if not any(settings.background):
        return colors
    uncovered = 1 - np.asarray(_device.to_host(alpha))[..., None]
    return np.asarray(colors + uncovered * np.asarray(settings.background, np.float32))


def _distance_in_middle(alpha: _Float32, depth: _Float32) -> float | None:
    """Return the median depth of the covered pixels around the middle, or None if none
    of them is covered."""
    middle = tuple(slice(side * 3 // 8, side * 5 // 8 + 1) for side in alpha.shape)
    covered = depth[middle][alpha[middle] > 0.5]
    if not covered.size:
        return None
    return float(np.median(covered))


def _depth_range(alpha: _Float32, depth: _Float32) -> tuple[float, float]:
    """Return the depths that are shown in the nearest and the farthest colour. They are
    percentiles, so that a few distant gaussians have no effect."""
    covered = depth[alpha > 0.5]
    if not covered.size:
        return 0.0, 1.0
    near, far = np.percentile(covered, (1, 99))
    return near, far


def _check(stop: _core.Stop | None) -> None:
    if stop is not None and stop.is_requested:
        raise Stopped("drawing was stopped")


def _bounds(scene: Scene) -> tuple[npt.NDArray[np.floating], float]:
    """Return the centre and the radius of a ball that contains nearly all of a scene,
    without the few distant outliers of trained assets."""
    corners: list[Floats] = [np.zeros((0, 3))]
    for number, bundle in enumerate(scene.bundles):
        is_of_bundle = scene.instance_bundle == number
        leaves = bundle.clusters.box[: bundle.level_range(0).stop].reshape(-1, 3)
        if not len(leaves):
            continue
        low, high = np.percentile(leaves.astype(np.float64), (2, 98), axis=0)
        box = np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=-1).reshape(-1, 3)
        scales = scene.scales[is_of_bundle]
        rotations = scene.rotations[is_of_bundle]
        turned = np.einsum("i,iab,kb->ika", scales, rotations, box)
        corners.append((turned + scene.positions[is_of_bundle, None]).reshape(-1, 3))
    points = np.concatenate(corners)
    if not len(points):
        return np.zeros(3), 1.0
    return ball_of_most(points)
