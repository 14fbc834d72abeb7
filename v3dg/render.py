"""Draw scenes, bundles and assets: select a cut, then project, bin and blend it."""

from __future__ import annotations

import math
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any, TypeAlias, cast, get_args, overload

from v3dg import _core, _device
from v3dg._device import Device
from v3dg._numbers import check, check_type, color, one_of, real
from v3dg.build.memory import in_bytes, in_mib, pool_bytes
from v3dg.bundle import Bundle
from v3dg.cameras import Camera, StereoCamera, check_camera, for_each
from v3dg.false_color import ColorBy
from v3dg.gaussians import Gaussians
from v3dg.image import RenderedImage, Stats
from v3dg.opening import File, opened
from v3dg.pool import Pool, PoolLook, chosen_bytes
from v3dg.residency import ResidentScene, residency
from v3dg.scene import Scene, Subject
from v3dg.select import CutOptions, Selection, over_budget, rule_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from typing_extensions import Unpack

_Memory: TypeAlias = int | str | None

_known_rule = lru_cache(64, typed=True)(rule_of)  # of pictures that follow each other

# Of pictures with levels, whose own error is far larger; docs/cuda.md has what it saves.
DEFAULT_MIN_TRANSMITTANCE = 1e-3
_BLACK = (0.0, 0.0, 0.0)  # behind most pictures


class _FrameOptions(CutOptions, total=False):
    cut: Selection | None
    background: Sequence[float]
    min_transmittance: float | None
    depth: bool


class _Options(_FrameOptions, total=False):
    device: str | Device
    color_by: ColorBy
    memory: int | str | None


@overload
def render(subject: Subject | File, camera: Camera, **options: Unpack[_Options]) -> RenderedImage: ...
@overload
def render(
    subject: Subject | File, camera: StereoCamera, **options: Unpack[_Options]
) -> tuple[RenderedImage, RenderedImage]: ...
@overload
def render(
    subject: Subject | File, camera: Sequence[Camera], **options: Unpack[_Options]
) -> list[RenderedImage]: ...
def render(
    subject: Subject | File,
    camera: Camera | StereoCamera | Sequence[Camera],
    *,
    tolerance: float | None = None,
    budget: int | None = None,
    min_level: int = 0,
    fade: float | None = None,
    cut: Selection | None = None,
    color_by: ColorBy = "appearance",
    background: Sequence[float] = _BLACK,
    min_transmittance: float | None = None,
    depth: bool = False,
    device: str | Device = "auto",
    memory: int | str | None = "auto",
) -> RenderedImage | tuple[RenderedImage, RenderedImage] | list[RenderedImage]:
    """Draw a scene, one bundle or one asset, for one camera or for several.

    Clusters whose gaussians each stand for at most `tolerance` px² are drawn in place of finer ones; level 0
    with the asset's own filter, coarser levels with the filter they were made for (V3DG, section 3.4; our
    metric is in docs/levels.md). An asset is drawn whole, without a filter.

    Args:
        subject: What to draw, in world space; or the file of it, which is then opened anew by every call.
        camera: Pinhole camera. With several, each has its own cut and its own picture, as if drawn alone. The
            eyes of a stereo camera share one cut, and one frame: two pictures, whose statistics are those of
            both together but for the gaussians that were selected.
        tolerance: As in `v3dg.select`; so are `budget` and `min_level`.
        fade: As in `v3dg.select`; weights multiply opacities. Give `v3dg.DEFAULT_FADE` for a film.
        cut: Draw what was selected before from this scene, whatever the camera: a cut to walk around. Takes
            the place of `tolerance`, `budget`, `min_level` and `fade`.
        color_by: "level" or "cluster" colours gaussians by their own, "residency" where pages are missing.
        background: Three numbers.
        min_transmittance: A pixel stops behind the gaussian that lets no more than this share of light
            through, 0 to 0.99, and gives that light to what it has blended: no channel is off by more than
            this times the difference to what lies behind. None is 0.001 for scenes and bundles, and draws
            assets as `v3dg.rasterize` does.
        depth: Draw the expected depth, too.
        device: "cpu" draws NumPy arrays; "cuda", or a certain one as "cuda:1", draws torch tensors there, on
            the stream that is torch's current one, and keeps on the device what the next picture of the same
            scene or bundle needs. Use a `Renderer` to say how long. "auto" is "cuda" where that works.
        memory: As in `Renderer`; each picture is settled.

    Raises:
        ValueError: An argument is not as above, or the coarsest cut has more gaussians than the budget; on
            CUDA that is raised where the picture is looked at.
        RuntimeError: `device` is "cuda" and something is missing for it.
    """
    where, shown = _device.resolve(device), opened(subject)
    one_of(color_by, "color_by", get_args(ColorBy))
    memory = pool_bytes(memory)
    make, key = partial(_Frame, shown, color_by, where, memory), ("frame", color_by, where, memory)
    frame = make() if isinstance(shown, Gaussians) else residency.once(shown, key, make)
    options: Any = {"tolerance": tolerance, "budget": budget, "min_level": min_level, "fade": fade}
    shade = shade_of(background, min_transmittance, isinstance(shown, Gaussians), depth)

    def picture(view: Any) -> Any:
        if cut is None:
            frame.settle(shown, view, **options)
        return frame.draw(shown, view, shade, cut, **options)

    return for_each(camera, picture)


class Renderer:
    """Draws one scene, bundle or asset on one device, with buffers of its own.

    On a CUDA device, enqueuing a picture on torch's current stream there waits for nothing, so pictures can
    be drawn ahead, and captured in a CUDA graph: draw once what the graph will meet, so that it is all on the
    device, then capture `render`; what was not drawn before is a RuntimeError. Keep the renderer as long as
    the graph, and capture again when the scene has changed. A picture that is under way when its scene is
    changed is finished first.

    With a budget and a fade, pictures are taken to follow each other: the tolerance goes in steps to the one
    at which a part of the budget is free, never below that of `render`, so that slow motion is steady; at
    rest it is there after eight pictures (docs/fades.md). Without a fade, pictures are those of `render`.

    With a pool, only a part of the bundles is resident, so that they may be far larger than memory: pages
    come in from the files as views need them, read by other threads. A picture waits for none of them: where
    one is missing, the coarser clusters above it are drawn; with a fade, pages fade in. Use `settle` for a
    picture that misses nothing. If a view needs more than there is room for, the tolerance is raised until it
    fits.

    Args:
        subject: As in `v3dg.render`.
        color_by: As in `v3dg.render`; with a pool on a CUDA device, "appearance".
        device: As in `v3dg.render`. The renderer stays on it, whichever device is torch's current one later.
        memory: Of a pool for gaussians on the device: bytes, or text like "2GB". All are resident if None.
            "auto" is None where all fit into what is free, less a quarter of that or 1 GiB; else half of it.

    Raises:
        RuntimeError: Something is missing for the device.
        ValueError: `memory` has no room for the coarsest level, or the coarsest page of a file is damaged.
    """

    def __init__(
        self,
        subject: Subject | File,
        *,
        color_by: ColorBy = "appearance",
        device: str | Device = "auto",
        memory: int | str | None = "auto",
    ) -> None:
        self._subject: Subject = opened(subject)
        self._frame = _Frame(self._subject, color_by, _device.resolve(device), pool_bytes(memory))
        self._steps = _core.BudgetSteps()

    @property
    def memory(self) -> int | None:
        """Bytes of the pool that it draws from; None where all is resident."""
        return self._frame.memory

    def __repr__(self) -> str:
        of = "all is resident" if self.memory is None else f"a pool of {in_mib(self.memory)}"
        return f"Renderer({self._subject!r}, {self._frame.device}, {of})"

    @overload
    def render(self, camera: Camera, **options: Unpack[_FrameOptions]) -> RenderedImage: ...
    @overload
    def render(
        self, camera: StereoCamera, **options: Unpack[_FrameOptions]
    ) -> tuple[RenderedImage, RenderedImage]: ...
    def render(
        self,
        camera: Camera | StereoCamera,
        *,
        tolerance: float | None = None,
        budget: int | None = None,
        min_level: int = 0,
        fade: float | None = None,
        cut: Selection | None = None,
        background: Sequence[float] = _BLACK,
        min_transmittance: float | None = None,
        depth: bool = False,
    ) -> RenderedImage | tuple[RenderedImage, RenderedImage]:
        """Draw as `v3dg.render` does, of what is resident."""
        shade = shade_of(background, min_transmittance, isinstance(self._subject, Gaussians), depth)
        options: Any = {"tolerance": tolerance, "budget": budget, "min_level": min_level, "fade": fade}
        drawn = self._frame.draw(self._subject, camera, shade, cut, None, self._steps, **options)
        return cast(RenderedImage | tuple[RenderedImage, RenderedImage], drawn)

    def settle(
        self,
        camera: Camera | StereoCamera,
        *,
        tolerance: float | None = None,
        budget: int | None = None,
        min_level: int = 0,
        fade: float | None = None,
        timeout: float = 30.0,
    ) -> None:
        """Wait until what a view needs is resident, so that its picture misses nothing.

        The picture is then the same, bit for bit, as if all were resident; or as it is at the tolerance that
        it says, where there is not enough room. That holds for the next picture, which is waited for, too, on
        a CUDA device. Returns at once where all is resident.

        Args:
            timeout: Seconds after which it gives up if not a single page came in.

        Raises:
            ValueError: A page is damaged; the message says which.
            OSError: A page cannot be read. A TimeoutError if the disk does not answer.
        """
        options: Any = {"tolerance": tolerance, "budget": budget, "min_level": min_level, "fade": fade}
        self._frame.settle(self._subject, camera, timeout, **options)


class _Frame:
    """Buffers that pictures of one subject are drawn with; it does not keep the subject alive."""

    def __init__(self, subject: Subject, color_by: ColorBy, device: Device, memory: _Memory) -> None:
        one_of(color_by, "color_by", get_args(ColorBy))
        self.device, self.color_by = device, color_by
        self._num_models = 0  # of the first bundles, to which a scene only adds
        self._references: tuple[Any, ...] | None = None  # to those that were taken
        self._pool: Pool | None = None
        self._resident: ResidentScene | None = None  # as it was last drawn
        self._has_settled = False  # and drawn nothing since
        # Without levels, or on a GPU in other colours, all has to be there.
        is_whole = isinstance(subject, Gaussians) or (device.is_cuda and color_by != "appearance")
        self._is_auto = memory == "auto" and not is_whole
        memory = None if memory == "auto" else memory
        self.memory = None if memory is None else in_bytes(memory)  # of the pool
        if isinstance(subject, Gaussians):
            check("memory", memory is None, f"None for an asset, without pages, got {memory}; leave it out")
            _check_asset(color_by)
            self._asset = _core.AssetFrame(_core.Model(_device.place(subject, device).rows))
        else:
            expected = f"'appearance' for a pool on a CUDA device, got {color_by!r}"
            check("color_by", memory is None or not is_whole, expected)
            self._frame = _core.SceneFrame(device.number)
            with residency.turn(device):
                self._take_models(residency.scene(subject, device))

    def draw(
        self,
        subject: Subject,
        camera: Camera | StereoCamera,
        shade: _core.Shade,
        cut: Selection | None,
        stop: _core.Stop | None = None,
        steps: _core.BudgetSteps | None = None,
        look: PoolLook | None = None,
        **options: Any,
    ) -> Any:
        """A picture; of a stereo camera, one for each eye. `stop` is for the CPU, `look` for pools."""
        check_camera(camera)
        if isinstance(camera, StereoCamera) and (cut is not None or isinstance(subject, Gaussians)):
            return tuple(self.draw(subject, eye, shade, cut, **options) for eye in camera.eyes)
        is_plain = {float, int, type(None)} >= {*map(type, options.values())}
        if isinstance(subject, Gaussians):
            check_asset = _check_known_asset if is_plain and cut is None else _check_asset
            check_asset(self.color_by, cut=cut, **options)
            assert isinstance(camera, Camera)
            drawing = self._asset.draw(camera.core, shade)
            return RenderedImage(drawing, lambda: _stats(drawing.finish(), 0.0))
        rule = (_known_rule if is_plain else rule_of)(**options)
        with residency.turn(self.device):
            self._resident = resident = residency.scene(subject, self.device, self._resident)
            pool = self._take_models(resident)
            if pool is not None:
                check("cut", cut is None, "none for a pool, which has its own, got one; give memory=None")
                before = pool.core.status().bytes_in
                shown = (look or PoolLook(self.color_by)).options(resident.bundles)
                drawn = camera.core, rule, shade, stop, steps
                drawing = self._frame.draw_resident(resident.core, pool.core, *drawn, **shown)
                now = pool.core.status()
                came_in: Any = dict(missing=now.missing, failed=now.failed, bytes_in=now.bytes_in - before)
            elif cut is None:
                drawing = self._frame.draw(resident.core, camera.core, rule, shade, stop, steps)
            else:
                assert isinstance(camera, Camera)
                _check_cut(cut, subject, resident, **options)
                pairs = self._here(cut.instance_ids), self._here(cut.cluster_ids)
                weights = None if cut.given_weights is None else self._here(cut.given_weights)
                drawing = self._frame.draw_cut(resident.core, camera.core, *pairs, shade, weights=weights)
            resident.add_drawing(drawing)

        def finish() -> Stats:
            stats = drawing.finish()
            if stats.exceeds_budget:
                raise over_budget(options["budget"], stats.gaussians)
            chosen = stats.tolerance_px2 if options["budget"] is not None else rule.tolerance_px2
            if pool is not None:
                return _stats(stats, stats.tolerance_px2)._replace(memory=self.memory, **came_in)
            return _stats(stats, chosen if cut is None else cut.tolerance)

        if not self.device.is_cuda:
            finish()
        elif self._has_settled:
            drawing.finish()  # which may draw again, with pages that other views put in place of its own
        self._has_settled = False
        left = RenderedImage(drawing, finish)
        return left if isinstance(camera, Camera) else (left, RenderedImage(drawing, finish, is_right=True))

    def settle(
        self, subject: Subject, camera: Camera | StereoCamera, timeout: float = 30.0, **options: Any
    ) -> None:
        """Bring in what a view needs, or what of it comes in so many `seconds`."""
        seconds = options.pop("seconds", math.inf)
        real(timeout, "timeout", "seconds, at least 0", 0)
        rule = rule_of(**options)
        if isinstance(subject, Gaussians) or (self.memory is None and not self._is_auto):
            return
        with residency.turn(self.device):
            resident = residency.scene(subject, self.device)
            pool = self._take_models(resident)
        if pool is not None:
            pool.settle(resident, (camera.core, rule), timeout, seconds)
            self._has_settled = True

    def _take_models(self, resident: ResidentScene) -> Pool | None:
        """Have the gaussians of the scene's bundles at hand: in a pool, or all of them."""
        if self._references is resident.references:  # as in most frames
            return self._pool
        with residency.lock:
            bundles = resident.bundles
            if self._is_auto and self.memory is None and self._num_models < len(bundles):
                self.memory = chosen_bytes(bundles, self.device)
            if self.memory is not None:
                tables = [residency.table(bundle) for bundle in bundles]
                if self._pool is None or self._pool.tables != tables:
                    self._pool = None  # its memory is needed
                    self._pool = Pool(bundles, tables, self.device, self.memory)
            elif self._num_models < len(bundles):
                residency.set_models(self._frame, bundles, self.device, self.color_by)
                self._num_models = len(bundles)
            self._references = resident.references
            return self._pool

    def pick(self, subject: Any, pixel: _core.Camera, rule: _core.Rule) -> Any:
        """(instance, cluster, weight, depth) of what a pool has there, or None; ValueError without a pool."""
        check("renderer", self.memory and not self.device.is_cuda, "one with a pool on the CPU")
        resident = residency.scene(subject, self.device)
        pool: Any = self._take_models(resident)
        return self._frame.pick_resident(resident.core, pool.core, pixel, rule)

    def _here(self, ids: Any) -> Any:
        if not self.device.is_cuda:
            return ids
        import torch

        return torch.tensor(ids, device=str(self.device))


def shade_of(
    background: Sequence[float], min_transmittance: float | None, is_asset: bool, depth: bool
) -> _core.Shade:
    """What `render` says of the two, as the core has it: below 0, pixels stop as `rasterize` has them."""
    stop = -1.0 if is_asset else DEFAULT_MIN_TRANSMITTANCE
    if min_transmittance is not None:
        stop = real(min_transmittance, "min_transmittance", "a share of light, 0 to 0.99", 0, 0.99)
    behind = list(_BLACK) if background is _BLACK else color(background, "background")
    return _core.Shade(background=behind, min_transmittance=stop, with_depth=bool(depth))


def _stats(s: _core.FrameStats, tolerance: float) -> Stats:
    return Stats(s.gaussians, s.in_frustum, tolerance, s.select_ms, s.draw_ms, tuple(s.levels))


def _check_asset(color_by: ColorBy, **options: Any) -> None:
    """An asset has no levels: refuse what asks for them."""
    for name, value in options.items():
        is_harmless = name in ("tolerance", "fade") or not value
        check(name, is_harmless, "a scene or a bundle to choose from, got an asset")
    expected = f"'appearance' for an asset, which has no levels, got {color_by!r}"
    check("color_by", color_by == "appearance", expected)
    rule_of(options.get("tolerance"), None, 0, fade=options.get("fade"))


_check_known_asset = lru_cache(64, typed=True)(_check_asset)  # as _known_rule


def _check_cut(cut: Selection, subject: Scene | Bundle, resident: ResidentScene, **options: Any) -> None:
    """Refuse a cut that is not of this scene as it is, and whatever else is asked for."""
    check_type("cut", cut, Selection, "a Selection of v3dg.select")
    for name, value in options.items():
        check(name, not value, f"nothing beside a cut, which has been chosen, got {value}")
    mine = cut.scene is subject or (isinstance(subject, Bundle) and cut.scene.bundles == (subject,))
    check("cut", mine, "a selection from this scene, got one from another")
    if isinstance(subject, Scene):
        cut.check(resident.revision)
