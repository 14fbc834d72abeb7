"""`v3dg.render`: single pictures, each settled."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, cast, get_args, overload

from v3dg import _device
from v3dg._device import Device
from v3dg._numbers import one_of
from v3dg.cameras import Camera, StereoCamera, check_camera, for_each
from v3dg.false_color import ColorBy
from v3dg.gaussians import Gaussians
from v3dg.image import RenderedImage
from v3dg.levels.memory import pool_bytes
from v3dg.opening import File, opened
from v3dg.pool import PoolSlot
from v3dg.render.frame import FrameSource, frame_of
from v3dg.render.picture import Picture
from v3dg.render.request import BLACK, CutRequest, FrameRequest, shade_of
from v3dg.residency import residency
from v3dg.scene import Subject
from v3dg.select import CutOptions, Selection

if TYPE_CHECKING:
    from collections.abc import Sequence

    from typing_extensions import Unpack


class _Options(CutOptions, total=False):
    cut: Selection | None
    background: Sequence[float]
    min_transmittance: float | None
    depth: bool
    device: str | Device
    color_by: ColorBy
    memory: int | str | None


@overload
def render(
    subject: Subject | File, camera: Camera, **options: Unpack[_Options]
) -> RenderedImage: ...
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
    background: Sequence[float] = BLACK,
    min_transmittance: float | None = None,
    depth: bool = False,
    device: str | Device = "auto",
    memory: int | str | None = "auto",
) -> RenderedImage | tuple[RenderedImage, RenderedImage] | list[RenderedImage]:
    """Draw a scene, one bundle or one asset, for one camera or for several.

    Clusters whose gaussians each stand for at most `tolerance` px² are drawn in place
    of finer ones; level 0 with the asset's own filter, coarser levels with the filter
    they were made for (V3DG, section 3.4; our metric is in docs/levels.md). An asset is
    drawn whole: without a filter, or as it was trained if that was with antialiasing
    (`Gaussians.antialiased`), with 0.3 px² and opacities compensated for it.

    Args:
        subject: What to draw, in world space; or the file of it, which is then opened
            anew by every call.
        camera: Pinhole camera. With several, each has its own cut and its own picture,
            as if drawn alone. The eyes of a stereo camera share one cut, and one frame:
            two pictures, whose statistics are those of both together but for the
            gaussians that were selected.
        tolerance: As in `v3dg.select`; so are `budget` and `min_level`.
        fade: As in `v3dg.select`; weights multiply opacities. Give `v3dg.DEFAULT_FADE`
            for a film.
        cut: Draw what was selected before from this scene, whatever the camera: a cut
            to walk around. Takes the place of `tolerance`, `budget`, `min_level` and
            `fade`.
        color_by: "level" or "cluster" colours gaussians by their own, "residency" where
            pages are missing.
        background: Three numbers.
        min_transmittance: A pixel stops behind the gaussian that lets no more than this
            share of light through, 0 to 0.99, and gives that light to what it has
            blended: no channel is off by more than this times the difference to what
            lies behind. None is 0.001 for scenes and bundles, and draws assets as
            `v3dg.rasterize` does.
        depth: Draw the expected depth, too.
        device: "cpu" draws NumPy arrays; "cuda", or a certain one as "cuda:1", draws
            torch tensors there, on the stream that is torch's current one, and keeps on
            the device what the next picture of the same scene or bundle needs. Use a
            `Renderer` to say how long. "auto" is "cuda" where that works.
        memory: As in `Renderer`; each picture is settled.

    Raises:
        ValueError: An argument is not as above, or the coarsest cut has more gaussians
            than the budget; on CUDA that is raised where the picture is looked at.
        RuntimeError: `device` is "cuda" and something is missing for it.
    """
    chosen_device = _device.resolve(device)
    opened_subject = opened(subject)
    one_of(color_by, "color_by", get_args(ColorBy))
    frame = _still_frame(opened_subject, color_by, chosen_device, pool_bytes(memory))
    cut_request = CutRequest(tolerance, budget, min_level, fade)
    shade = shade_of(background, min_transmittance, isinstance(opened_subject, Gaussians), depth)

    def picture(view: Camera | StereoCamera) -> Picture:
        check_camera(view)
        request = FrameRequest(view, cut_request, shade, cut)
        return frame.chosen(opened_subject).draw_settled(opened_subject, request)

    pictures: Picture | list[Picture] = for_each(camera, picture)
    return cast(
        "RenderedImage | tuple[RenderedImage, RenderedImage] | list[RenderedImage]", pictures
    )


def _still_frame(
    subject: Subject, color_by: ColorBy, device: Device, memory: int | Literal["auto"] | None
) -> FrameSource:
    """The frame that stills of a subject are drawn with, which is kept with a scene or
    a bundle.

    All colours share a pool. Of pools of a given size, only the last one is kept.
    """
    if isinstance(subject, Gaussians):
        return frame_of(subject, color_by, device, memory, PoolSlot())
    is_sized = isinstance(memory, int)
    slot = residency.once(subject, ("pool", device, is_sized), PoolSlot)

    def make() -> FrameSource:
        return frame_of(subject, color_by, device, memory, slot)

    if is_sized:
        return residency.last(subject, ("frame", color_by, device), memory, make)
    return residency.once(subject, ("frame", color_by, device, memory), make)
