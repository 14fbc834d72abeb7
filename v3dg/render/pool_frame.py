"""The frame of a pool: of a scene's gaussians, those are resident that views need and
that have room."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from v3dg import _core
from v3dg._device import Device
from v3dg._numbers import check, real
from v3dg.cameras import Camera, StereoCamera
from v3dg.image import Stats
from v3dg.pool import Pool, PoolLook, PoolSlot
from v3dg.render.picture import Picture, picture_of, stats_of
from v3dg.render.request import CutRequest
from v3dg.residency import ResidentScene, residency
from v3dg.select import over_budget

if TYPE_CHECKING:
    import weakref

    from v3dg.bundle import Bundle
    from v3dg.false_color import ColorBy
    from v3dg.scene import Subject
    from v3dg.select import Selection

_STILL_TIMEOUT_SECONDS = 30.0


class PoolFrame:
    """Draws a scene or a bundle on one device from a pool.

    It does not keep the subject alive.

    Attributes:
        device: Where it draws.
        memory: Bytes of the pool.
    """

    def __init__(self, color_by: ColorBy, device: Device, memory: int, slot: PoolSlot) -> None:
        expected = f"'appearance' for a pool on a CUDA device, got {color_by!r}"
        check("color_by", not device.is_cuda or color_by == "appearance", expected)
        self.device = device
        self.memory: int | None = memory
        self._num_bytes = memory
        self._look = PoolLook(color_by)
        self._slot = slot
        self._core = _core.SceneFrame(device.number)
        self._pool: Pool | None = None
        self._references: tuple[weakref.ref[Bundle], ...] | None = None
        self._resident: ResidentScene | None = None  # as it was last drawn
        self._has_settled = False  # and drawn nothing since

    @property
    def core(self) -> _core.PagePool:
        """The core's part of the pool."""
        assert self._pool is not None
        return self._pool.core

    def take(self, resident: ResidentScene) -> Pool:
        """The pool of the scene's bundles."""
        pool = self._pool
        if pool is not None and self._references is resident.references:  # as in most pictures
            return pool
        with residency.lock:
            bundles = resident.bundles
            tables = [residency.table(bundle) for bundle in bundles]
            pool = None  # both references end, because the memory of the pool may be needed
            self._pool = None
            pool = self._slot.pool(bundles, tables, self.device, self._num_bytes)
            self._pool = pool
            self._references = resident.references
            return pool

    def draw(
        self,
        subject: Subject,
        camera: Camera | StereoCamera,
        request: CutRequest,
        shade: _core.Shade,
        cut: Selection | None = None,
        steps: _core.BudgetSteps | None = None,
        stop: _core.Stop | None = None,
        look: PoolLook | None = None,
    ) -> Picture:
        """Draw what is resident of a cut, after bringing in pages that are ready.

        Args:
            steps: The pacing of pictures that follow each other; None for a single one.
            stop: Ends a picture early on the CPU.
            look: What to show in place of the frame's own colours, on the CPU.
        """
        _refuse_cut(cut)
        with residency.turn(self.device):
            resident = residency.scene(subject, self.device, self._resident)
            self._resident = resident
            pool = self.take(resident)
            picture = self._enqueue(resident, pool, camera, request, shade, steps, stop, look)
        if not self.device.is_cuda:
            _finish(picture)
        elif self._has_settled:
            _finish(
                picture
            )  # which may draw again, from pages that other views put in place of its own
        self._has_settled = False
        return picture

    def draw_settled(
        self,
        subject: Subject,
        camera: Camera | StereoCamera,
        request: CutRequest,
        shade: _core.Shade,
        cut: Selection | None = None,
    ) -> Picture:
        """Settle and draw in one step, between which no other thread's view gets at the
        pool."""
        _refuse_cut(cut)
        while True:
            with residency.turn(self.device):
                resident = residency.scene(subject, self.device)
                revision = resident.revision
                pool = self.take(resident)
            with pool.lease:
                pool.settle(resident, camera.core, request.rule, _STILL_TIMEOUT_SECONDS, math.inf)
                with residency.turn(self.device):
                    if (
                        resident.revision != revision
                    ):  # Another thread has changed the scene meanwhile.
                        continue
                    picture = self._enqueue(
                        resident, pool, camera, request, shade, None, None, None
                    )
                _finish(picture)
                return picture

    def settle(
        self,
        subject: Subject,
        camera: Camera | StereoCamera,
        request: CutRequest,
        timeout: float = _STILL_TIMEOUT_SECONDS,
        seconds: float = math.inf,
    ) -> None:
        """Bring in what a view needs, or what of it comes in within `seconds`; errors
        as of `Pool.settle`."""
        real(timeout, "timeout", "seconds, at least 0", 0)
        rule = request.rule
        with residency.turn(self.device):
            resident = residency.scene(subject, self.device)
            pool = self.take(resident)
        with pool.lease:
            pool.settle(resident, camera.core, rule, timeout, seconds)
        self._has_settled = True

    def pick(
        self, subject: Subject, pixel: _core.Camera, rule: _core.Rule
    ) -> tuple[int, int, float, float] | None:
        """Instance, cluster, weight and depth of what a pixel shows most of; only on
        the CPU."""
        resident = residency.scene(subject, self.device)
        pool = self.take(resident)
        return self._core.pick_resident(resident.core, pool.core, pixel, rule)

    def _enqueue(
        self,
        resident: ResidentScene,
        pool: Pool,
        camera: Camera | StereoCamera,
        request: CutRequest,
        shade: _core.Shade,
        steps: _core.BudgetSteps | None,
        stop: _core.Stop | None,
        look: PoolLook | None,
    ) -> Picture:
        bytes_in_at_start = pool.core.status().bytes_in
        look = look or self._look
        drawing = self._core.draw_resident(
            resident.core,
            pool.core,
            camera.core,
            request.rule,
            shade,
            stop,
            steps,
            shows=look.shows,
            colors=look.palettes(resident.bundles),
            chooser=look.core_chooser,
            aside=look.aside,
        )
        status = pool.core.status()
        resident.add_drawing(drawing)

        def finish() -> Stats:
            stats = drawing.finish()
            if stats.exceeds_budget:
                assert request.budget is not None
                raise over_budget(request.budget, stats.gaussians)
            return stats_of(stats, stats.tolerance_px2)._replace(
                missing=status.missing,
                failed=status.failed,
                bytes_in=status.bytes_in - bytes_in_at_start,
                memory=pool.num_bytes,
            )

        return picture_of(drawing, camera, finish)


def _finish(picture: Picture) -> None:
    """Wait for a picture, and raise what went wrong."""
    if isinstance(picture, tuple):
        picture = picture[0]
    picture.stats  # noqa: B018


def _refuse_cut(cut: Selection | None) -> None:
    check("cut", cut is None, "none for a pool, which has its own, got one; give memory=None")
