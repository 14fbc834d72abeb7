"""The frame of a pool. Of a scene's gaussians, only those are resident that views need
and that fit into the pool."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from v3dg import _core
from v3dg._device import Device
from v3dg._numbers import check, real
from v3dg.cameras import Camera, StereoCamera
from v3dg.image import Stats
from v3dg.pool import Pool, PoolSlot
from v3dg.render.picture import Picture, picture_of, stats_of
from v3dg.render.request import CutRequest, FrameRequest, Look
from v3dg.residency import ResidentScene, residency
from v3dg.select import over_budget

if TYPE_CHECKING:
    import weakref

    from v3dg.bundle import Bundle
    from v3dg.false_color import ColorBy
    from v3dg.scene import Subject

_STILL_TIMEOUT_SECONDS = 30.0


class PoolFrame:
    """Draws a scene or a bundle on one device from a pool.

    The frame does not keep the subject alive.

    Attributes:
        device: The device that draws.
        memory: Size of the pool in bytes.
    """

    def __init__(self, color_by: ColorBy, device: Device, memory: int, slot: PoolSlot) -> None:
        expected = f"'appearance' for a pool on a CUDA device, got {color_by!r}"
        check("color_by", not device.is_cuda or color_by == "appearance", expected)
        self.device = device
        self.memory: int | None = memory
        self._num_bytes = memory
        self._look = Look(color_by)
        self._slot = slot
        self._core = _core.SceneFrame(device.number)
        self._pool: Pool | None = None
        self._references: tuple[weakref.ref[Bundle], ...] | None = None
        self._resident: ResidentScene | None = None  # the scene as of the last picture
        self._has_settled = False  # whether `settle` was called after the last picture

    @property
    def core(self) -> _core.PagePool:
        """The core's part of the pool."""
        assert self._pool is not None
        return self._pool.core

    def take(self, resident: ResidentScene) -> Pool:
        """Return the pool of the scene's bundles."""
        pool = self._pool
        # the usual case
        if pool is not None and self._references is resident.references:
            return pool
        with residency.lock:
            bundles = resident.bundles
            tables = [residency.table(bundle) for bundle in bundles]
            # Drop both references to the old pool, because the new pool may need its
            # memory.
            pool = None
            self._pool = None
            pool = self._slot.pool(bundles, tables, self.device, self._num_bytes)
            self._pool = pool
            self._references = resident.references
            return pool

    def chosen(self, subject: Subject) -> PoolFrame:
        """Return this frame."""
        return self

    def draw(
        self,
        subject: Subject,
        request: FrameRequest,
        steps: _core.BudgetSteps | None = None,
        stop: _core.Stop | None = None,
    ) -> Picture:
        """Bring in pages that are ready, then draw the resident part of a cut."""
        _refuse_given_cut(request)
        with residency.turn(self.device):
            resident = residency.scene(subject, self.device, self._resident)
            self._resident = resident
            pool = self.take(resident)
            picture = self._enqueue(resident, pool, request, steps, stop)
        if not self.device.is_cuda:
            _finish(picture)
        elif self._has_settled:
            # If buffers were too small, finishing the picture draws it again. Finish it
            # now, while the pages that `settle` brought in are still resident.
            _finish(picture)
        self._has_settled = False
        return picture

    def draw_settled(self, subject: Subject, request: FrameRequest) -> Picture:
        """Settle and draw in one step. Views of other threads cannot use the pool in
        between."""
        _refuse_given_cut(request)
        camera = request.camera.core
        while True:
            with residency.turn(self.device):
                resident = residency.scene(subject, self.device)
                revision = resident.revision
                pool = self.take(resident)
            with pool.lease:
                pool.settle(resident, camera, request.cut.rule, _STILL_TIMEOUT_SECONDS, math.inf)
                with residency.turn(self.device):
                    # another thread has changed the scene
                    if resident.revision != revision:
                        continue
                    picture = self._enqueue(resident, pool, request, None, None)
                _finish(picture)
                return picture

    def settle(
        self,
        subject: Subject,
        camera: Camera | StereoCamera,
        cut: CutRequest,
        timeout: float = _STILL_TIMEOUT_SECONDS,
        seconds: float = math.inf,
    ) -> None:
        """Bring in the pages that a view needs, or as many of them as arrive within
        `seconds`. The errors are those of `Pool.settle`."""
        real(timeout, "timeout", "seconds, at least 0", 0)
        rule = cut.rule
        with residency.turn(self.device):
            resident = residency.scene(subject, self.device)
            pool = self.take(resident)
        with pool.lease:
            pool.settle(resident, camera.core, rule, timeout, seconds)
        self._has_settled = True

    def pick(self, subject: Subject, pixel: _core.Camera, rule: _core.Rule) -> _core.Pick | None:
        """Return the gaussian with the largest weight in a pixel. This works only on
        the CPU."""
        resident = residency.scene(subject, self.device)
        pool = self.take(resident)
        request = _core.FrameRequest(pixel, rule, look=_core.Look(aside=True))
        return self._core.pick(resident.core, request, pool.core)

    def _enqueue(
        self,
        resident: ResidentScene,
        pool: Pool,
        request: FrameRequest,
        steps: _core.BudgetSteps | None,
        stop: _core.Stop | None,
    ) -> Picture:
        bytes_in_at_start = pool.core.status().bytes_in
        look = request.look or self._look
        core_request = _core.FrameRequest(
            request.camera.core,
            request.cut.rule,
            request.shade,
            None,
            look.core(resident.bundles),
            request.sensor,
        )
        drawing = self._core.draw(resident.core, core_request, pool.core, steps, stop)
        status = pool.core.status()
        resident.add_drawing(drawing)
        budget = request.cut.budget

        def finish() -> Stats:
            stats = drawing.finish()
            if stats.exceeds_budget:
                assert budget is not None
                raise over_budget(budget, stats.gaussians)
            return stats_of(stats, stats.tolerance_px2)._replace(
                missing=status.missing,
                failed=status.failed,
                bytes_in=status.bytes_in - bytes_in_at_start,
                memory=pool.num_bytes,
            )

        return picture_of(drawing, request.camera, finish)


def _finish(picture: Picture) -> None:
    """Wait for a picture, and raise its error if there is one."""
    if isinstance(picture, tuple):
        picture = picture[0]
    picture.stats  # noqa: B018


def _refuse_given_cut(request: FrameRequest) -> None:
    if request.selection is not None:
        raise ValueError(
            "cut: a renderer with a pool selects its own cut; leave it out, or create the renderer "
            "with memory=None"
        )
