"""`v3dg render`."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from v3dg.cli._common import Flag, Threads, option, print_result, require_subject, table_lines
from v3dg.cli._views import ViewOptions, Views, choose_cameras, load_subject, picture_path


@dataclass
class Render:
    """Draw a scene from its cameras, a bundle or an asset from a turntable, or any from a camera file."""

    subject: tyro.conf.Positional[Path]
    """A scene (.json), a bundle (.v3dg) or an asset (.ply, .spz, ...)."""
    output: Annotated[Path | None, option("PATH", "-o")] = None
    """Picture to write, .png or .jpg; several get a number or the camera's name. Default: as the subject."""
    tolerance: Annotated[float | None, option("PX2")] = None
    """Screen area in px² that one gaussian of a coarser cluster may stand for; 0 draws everything."""
    budget: Annotated[int | None, option("N")] = None
    """Most gaussians to draw in one picture; without a tolerance, the picture is as fine as that allows."""
    min_level: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Draw no level finer than this, except where an asset has no coarser one."""
    color_by: Literal["appearance", "level", "cluster"] = "appearance"
    """What a gaussian's colour shows."""
    background: Annotated[tuple[float, float, float], tyro.conf.arg(metavar="R G B")] = (0.0, 0.0, 0.0)
    """Red, green and blue of the background, each 0 to 1."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to draw; auto is a CUDA device where there is one and torch can use it."""
    threads: Threads = None
    """CPU threads; all if not given."""
    json: Flag = False
    """Print the numbers as JSON."""
    view: Views = field(default_factory=ViewOptions)


def run(options: Render) -> None:
    require_subject(options.subject)
    from v3dg import _device
    from v3dg.pictures import check_picture_path, write_picture
    from v3dg.render import render

    options.view.check(options.subject)
    output = check_picture_path(options.output or Path(options.subject.with_suffix(".png").name))
    device = _device.resolve(options.device)
    subject, own_cameras = load_subject(options.subject)
    cameras = choose_cameras(options.view, options.subject, subject, own_cameras)
    results = []
    for name, camera in cameras.items():
        image = render(
            subject,
            camera,
            tolerance=options.tolerance,
            budget=options.budget,
            min_level=options.min_level,
            color_by=options.color_by,
            background=options.background,
            device=device,
        )
        path = picture_path(output, name, len(cameras))
        write_picture(path, _device.to_host(image.color))
        stats = image.stats
        results.append(
            {
                "picture": str(path),
                "camera": name,
                "width": camera.width,
                "height": camera.height,
                "gaussians_selected": stats.gaussians_selected,
                "gaussians_in_frustum": stats.gaussians_in_frustum,
                # JSON has no infinity, which a budget can come to.
                "tolerance": stats.tolerance if math.isfinite(stats.tolerance) else None,
                "select_ms": stats.select_ms,
                "draw_ms": stats.draw_ms,
            }
        )
    rows = [
        (
            str(r["picture"]),
            f"{r['width']} x {r['height']}",
            f"{r['gaussians_selected']:,}",
            f"{r['gaussians_in_frustum']:,}",
            f"{r['select_ms']:.1f}",
            f"{r['draw_ms']:.1f}",
        )
        for r in results
    ]
    header = ("picture", "size", "selected", "in frustum", "select ms", "draw ms")
    print_result(
        options.json,
        {"subject": str(options.subject), "pictures": results},
        lambda: "\n".join(table_lines(header, rows)),
    )
