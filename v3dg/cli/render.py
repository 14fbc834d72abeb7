"""`v3dg render`."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from v3dg import _device
from v3dg._json import JsonObject
from v3dg._progress import counted
from v3dg._urls import beside, shown
from v3dg.cameras import Camera
from v3dg.cli._common import (
    Column,
    Cut,
    OnPool,
    check_usage,
    finite,
    option,
    print_result,
    table_lines,
)
from v3dg.cli._views import ViewOptions, Views, choose_cameras, choose_up, picture_paths
from v3dg.false_color import ColorBy
from v3dg.opening import open_with_cameras
from v3dg.pictures import check_picture_path, write_picture
from v3dg.render import Renderer
from v3dg.select import DEFAULT_FADE, CutOptions


@dataclass
class Render(Cut, OnPool):
    """Draw a scene from its cameras, a bundle or an asset from a turntable, or any of
    them from a camera file."""

    subject: tyro.conf.Positional[Path]
    """A scene (.json), a bundle (.v3dg) or an asset (.ply, .spz, ...)."""
    output: Annotated[Path | None, option("PATH", "-o")] = None
    """Picture to write, .png or .jpg; several pictures get a number or the camera's
    name. By default the name is that of the subject."""
    min_level: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Draw no level finer than this, except where an asset has no coarser one."""
    fade: Annotated[float | None, option("FACTOR")] = None
    """Blend two levels within this factor of the tolerance, and draw level 0 with a
    low-pass filter, so that a film neither pops nor flickers. By default 1.02 for
    several views of a turntable, otherwise 1, which turns it off."""
    color_by: ColorBy = "appearance"
    """Property that the colours show."""
    background: Annotated[tuple[float, float, float], tyro.conf.arg(metavar="R G B")] = (
        0.0,
        0.0,
        0.0,
    )
    """Red, green and blue of the background, each 0 to 1."""
    view: Views = field(default_factory=ViewOptions)


def run(options: Render) -> None:
    options.view.check(options.subject)
    is_color = all(0 <= part <= 1 for part in options.background)
    check_usage("--background", is_color, f"three numbers from 0 to 1, got {options.background}")
    output = check_picture_path(
        options.output or Path(beside(options.subject).with_suffix(".png").name)
    )
    device = _device.resolve(options.device)
    subject, own_cameras = open_with_cameras(options.subject)
    is_turntable = options.view.cameras is None and own_cameras is None
    notes: list[str] = []
    if is_turntable:
        options.view.up, notes = choose_up(options.view.up, subject, None, options.subject)
    cameras = choose_cameras(options.view, options.subject, subject, own_cameras)
    fade = options.fade
    if fade is None and is_turntable and len(cameras) > 1:
        fade = DEFAULT_FADE
    # The pictures of a fade are a sequence, in which the tolerance of a budget changes
    # in steps.
    renderer = Renderer(subject, color_by=options.color_by, device=device, memory=options.pool())
    pictures = _draw(options, renderer, cameras, output, fade)
    columns = [
        Column("picture", "{picture}"),
        Column("size", "{width} x {height}"),
        Column("selected", "{gaussians_selected:,}"),
        Column("in frustum", "{gaussians_in_frustum:,}"),
        Column("select ms", "{select_ms:.1f}"),
        Column("draw ms", "{draw_ms:.1f}"),
    ]
    result = {"subject": shown(options.subject), "pictures": pictures}
    print_result(result, [*table_lines(columns, pictures), *notes], as_json=options.json)


def _draw(
    options: Render,
    renderer: Renderer,
    cameras: Mapping[str, Camera],
    output: Path,
    fade: float | None,
) -> list[JsonObject]:
    """Draw and write the picture of each camera; returns their descriptions."""
    views = list(zip(picture_paths(output, cameras), cameras.items(), strict=True))
    show = len(views) > 1 and not options.quiet
    cut = CutOptions(
        tolerance=options.tolerance, budget=options.budget, min_level=options.min_level, fade=fade
    )
    pictures: list[JsonObject] = []
    for path, (name, camera) in counted(views, len(views), "render", show):
        renderer.settle(camera, **cut)
        image = renderer.render(camera, **cut, background=options.background)
        write_picture(path, _device.to_host(image.color))
        picture: JsonObject = {
            "picture": str(path),
            "camera": name,
            "width": camera.width,
            "height": camera.height,
            **image.stats._asdict(),
        }
        picture["tolerance"] = finite(image.stats.tolerance)
        pictures.append(picture)
    return pictures
