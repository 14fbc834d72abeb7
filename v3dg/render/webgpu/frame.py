"""The frame of a scene that WebGPU draws. The core on the CPU selects the cut."""

from __future__ import annotations

import copy
import threading
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

from v3dg import _core, _system
from v3dg._device import CPU, WEBGPU
from v3dg._numbers import check
from v3dg.cameras import Camera
from v3dg.gaussians import Gaussians
from v3dg.image import FinishedImage, Planes, Stats
from v3dg.render.scene_frame import check_cut
from v3dg.render.webgpu.drawer import Drawer
from v3dg.render.webgpu.gpu import Gpu
from v3dg.render.webgpu.layout import ClusterCodes, lay_out
from v3dg.residency import residency
from v3dg.select import select_by

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from v3dg._device import Device
    from v3dg.bundle import Bundle
    from v3dg.cameras import StereoCamera
    from v3dg.false_color import ColorBy
    from v3dg.render.request import CutRequest, FrameRequest
    from v3dg.render.webgpu.drawer import Drawn
    from v3dg.scene import Scene, Subject
    from v3dg.select import Selection


class WebGpuFrame:
    """Draws a scene or a bundle with WebGPU.

    Attributes:
        device: Always WEBGPU.
        memory: None, because this frame has no pool.
    """

    def __init__(self) -> None:
        self.device: Device = WEBGPU
        self.memory: int | None = None

    def chosen(self, subject: Subject) -> WebGpuFrame:
        """Return this frame."""
        return self

    def draw(
        self,
        subject: Subject,
        request: FrameRequest,
        steps: _core.BudgetSteps | None = None,
        stop: _core.Stop | None = None,
    ) -> FinishedImage:
        """Draw the requested cut. The picture is finished when this returns."""
        _check_request(request)
        assert isinstance(request.camera, Camera)
        assert not isinstance(subject, Gaussians)
        start = time.perf_counter()
        if request.selection is None:
            cut = request.cut
            selection = select_by(cut.rule, subject, request.camera, cut.budget, CPU, steps)
        else:
            selection = request.selection
            check_cut(selection, subject, residency.scene(subject, CPU), request.cut)
        selected = time.perf_counter()
        drawn = _drawn(selection, request.camera, request.shade)
        stats = Stats(
            gaussians_selected=selection.num_gaussians,
            gaussians_in_frustum=drawn.num_gaussians,
            tolerance=selection.tolerance,
            select_ms=1e3 * (selected - start),
            draw_ms=1e3 * (time.perf_counter() - selected),
        )
        return FinishedImage(_planes_of(drawn, request.shade), stats)

    draw_settled = draw

    def settle(
        self, subject: Subject, camera: Camera | StereoCamera, cut: CutRequest, timeout: float
    ) -> None:
        """Return at once, because each picture brings in all pages that it needs."""


def check_subject(subject: Subject, color_by: ColorBy, memory: int | str | None) -> None:
    """Raise ValueError unless WebGPU can draw a subject with these arguments of
    `v3dg.Renderer`."""
    if isinstance(subject, Gaussians):
        raise ValueError(
            "subject: expected a scene or a bundle with device='webgpu', got an asset; build a "
            "bundle with v3dg.build_bundle"
        )
    check(
        "color_by",
        color_by == "appearance",
        f"'appearance' with device='webgpu', got {color_by!r}; use 'cpu' or 'cuda'",
    )
    check(
        "memory",
        memory is None or memory == "auto",
        f"None with device='webgpu', which has no pool, got {memory}; use 'cpu' or 'cuda'",
    )


def _check_request(request: FrameRequest) -> None:
    """Raise ValueError unless WebGPU can draw a picture."""
    camera = request.camera
    if not isinstance(camera, Camera):
        raise ValueError(
            "camera: expected a pinhole with device='webgpu', got a stereo camera; draw its eyes "
            "one by one"
        )
    check(
        "camera",
        not camera.is_distorted,
        f"a pinhole with device='webgpu', got {camera.model}; use 'cpu' or 'cuda'",
    )
    check(
        "depth",
        not request.shade.with_depth,
        "False with device='webgpu', got True; use 'cpu' or 'cuda'",
    )
    check(
        "channels",
        request.sensor is None,
        "no channels and no mesh with device='webgpu', got some; use 'cpu' or 'cuda'",
    )


class _SharedDrawer:
    """The drawer of this process, which pictures use one after another."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self._drawer: Drawer | None = None
        _system.at_fork(in_child=self._after_fork)

    def get(self) -> Drawer:
        """Return the drawer; the lock must be held.

        Raises:
            ImportError: The package wgpu is missing.
            RuntimeError: The machine has no adapter.
        """
        if self._drawer is None:
            self._drawer = Drawer(Gpu())
        return self._drawer

    def _after_fork(self) -> None:
        # A child has none of the threads of the driver.
        self.lock = threading.Lock()
        self._drawer = None


_shared = _SharedDrawer()


def _drawn(selection: Selection, camera: Camera, shade: _core.Shade) -> Drawn:
    """Draw a cut."""
    scene = copy.copy(selection.scene)  # other threads may change the original meanwhile
    bundles = scene.bundles
    codes = [_codes_of(bundle) for bundle in bundles]
    with _shared.lock, _memory_errors():
        drawer = _shared.get()
        pages = _pages_of(selection, scene, codes)
        places = drawer.pool.bring_in(bundles, pages)
        cut = lay_out(
            scene,
            selection.instance_ids,
            selection.cluster_ids,
            selection.given_weights,
            codes,
            places,
        )
        return drawer.draw(cut, scene, camera, _stop_of(shade, selection.tolerance))


def _codes_of(bundle: Bundle) -> ClusterCodes:
    def make() -> ClusterCodes:
        return ClusterCodes.of(bundle.clusters, bundle.page_layout, bundle.sh_degree)

    return residency.once(bundle, "cluster codes", make)


def _pages_of(
    selection: Selection, scene: Scene, codes: Sequence[ClusterCodes]
) -> list[NDArray[np.int64]]:
    """Return the pages of each bundle that a cut needs."""
    bundle_from_pair = scene.instance_bundle[selection.instance_ids]
    return [
        np.unique(table.page[selection.cluster_ids[bundle_from_pair == number]])
        for number, table in enumerate(codes)
    ]


def _stop_of(shade: _core.Shade, tolerance: float) -> float:
    """Return the transmittance behind which pixels stop."""
    if shade.min_transmittance == _core.stops_by_cut:
        return _core.stop_of_tolerance(tolerance)
    return shade.min_transmittance


def _planes_of(drawn: Drawn, shade: _core.Shade) -> Planes:
    """Return a picture over its background."""
    alpha = np.ascontiguousarray(drawn.pixels[..., 3])
    color = np.ascontiguousarray(drawn.pixels[..., :3])
    background = np.asarray(shade.background, np.float32)
    if background.any():
        color += (1 - alpha[..., None]) * background
    return Planes(color, alpha, None)


@contextmanager
def _memory_errors() -> Iterator[None]:
    """Convert the error of wgpu for too little device memory to MemoryError."""
    try:
        yield
    except Exception as error:
        if type(error).__name__ != "GPUOutOfMemoryError":
            raise
        raise MemoryError(str(error)) from error
