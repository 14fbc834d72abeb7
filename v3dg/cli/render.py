"""`v3dg render`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from v3dg.cli._common import (
    UsageError,
    level_size,
    load_asset_or_bundle,
    print_result,
    require_file,
    table_lines,
)

if TYPE_CHECKING:
    from v3dg.bundle import Bundle
    from v3dg.cameras import Camera
    from v3dg.gaussians import Gaussians
    from v3dg.scene import Scene


# Gaussians of the level that a turntable is centred on: enough to know where things are, quick to read.
_ENOUGH_TO_FRAME = 50_000


@dataclass
class Render:
    """Draw a scene from its cameras, a bundle or an asset from a turntable, or any from a camera file."""

    subject: tyro.conf.Positional[Path]
    """A scene (.json), a bundle (.v3dg) or an asset (.ply)."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="PATH")] = None
    """Picture to write, .png or .jpg; several get a number or the camera's name. Default: as the subject."""
    cameras: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Draw from the cameras of this nerfstudio transforms.json."""
    distortion: Literal["refuse", "ignore"] = "refuse"
    """Whether lens distortion in that file is an error, or left out of the pictures."""
    camera: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Draw only this camera of a file with cameras: its name, or its place in the file, from 0."""
    views: int = 1
    """Views around the turntable."""
    size: Annotated[tuple[int, int], tyro.conf.arg(metavar="W H")] = (800, 800)
    """Width and height in px of a turntable's pictures, and of cameras whose file gives them no size."""
    elevation: float = 20.0
    """Height of the turntable's cameras above the horizon in degrees."""
    up: Literal["x", "y", "z", "-x", "-y", "-z"] = "z"
    """The turntable's axis."""
    tolerance: Annotated[float | None, tyro.conf.arg(metavar="PX2")] = None
    """Screen area in px² that one gaussian of a coarser cluster may stand for; 0 draws everything."""
    budget: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Most gaussians to draw in one picture; without a tolerance, as fine as that allows."""
    min_level: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Draw no level finer than this, except where an asset has no coarser one."""
    color_by: Literal["appearance", "level", "cluster"] = "appearance"
    """What a gaussian's colour shows."""
    background: Annotated[tuple[float, float, float], tyro.conf.arg(metavar="R G B")] = (0.0, 0.0, 0.0)
    """Colour behind, each 0 to 1."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to draw; auto is a CUDA device where there is one and torch can use it."""
    threads: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """CPU threads; all if not given."""
    json: bool = False
    """Print the numbers as JSON."""


def run(options: Render) -> None:
    require_file(options.subject, ".ply", ".v3dg", ".json")
    from v3dg import _device
    from v3dg.pictures import check_picture_path, write_picture
    from v3dg.render import render

    if min(options.views, *options.size) < 1:
        raise UsageError("--views, --size: expected at least 1")
    output = check_picture_path(options.output or Path(options.subject.with_suffix(".png").name))
    device = _device.resolve(options.device)
    subject, cameras = _subject_and_cameras(options)
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
        path = output
        if len(cameras) > 1:
            path = output.with_name(f"{output.stem}_{_safe(name)}{output.suffix}")
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


def _subject_and_cameras(options: Render) -> tuple[Scene | Bundle | Gaussians, dict[str, Camera]]:
    """What to draw, and from where: the file of --cameras, else a scene's own cameras, else a turntable."""
    is_scene = options.subject.suffix == ".json"
    if options.cameras is None and not is_scene:
        if options.camera is not None:
            raise UsageError("--camera: expected --cameras or a scene (.json) to take it from; leave it out")
        loaded = load_asset_or_bundle(options.subject)
        return loaded, _turntable(loaded, options)
    subject: Scene | Bundle | Gaussians
    cameras: dict[str, Camera] = {}
    if is_scene:
        from v3dg.scene_file import read_scene

        subject, cameras = read_scene(options.subject)
    else:
        subject = load_asset_or_bundle(options.subject)
    if options.cameras is not None:
        from v3dg.camera_file import read_cameras

        cameras = read_cameras(options.cameras, size=options.size, distortion=options.distortion)
    if not cameras:
        raise ValueError(
            f"{options.cameras or options.subject}: expected cameras, got a file without; add some to it"
        )
    return subject, cameras if options.camera is None else _one_camera(cameras, options.camera)


def _one_camera(cameras: dict[str, Camera], name: str) -> dict[str, Camera]:
    """The camera of that name or at that place."""
    names = list(cameras)
    if name not in cameras and name.isdecimal() and int(name) < len(names):
        name = names[int(name)]
    if name not in cameras:
        known = ", ".join(names[:8]) + (" ..." if len(names) > 8 else "")
        raise ValueError(f"--camera: expected one of {known}, or 0 to {len(names) - 1}, got {name}")
    return {name: cameras[name]}


def _turntable(subject: Bundle | Gaussians, options: Render) -> dict[str, Camera]:
    """Cameras around where most of the gaussians are, at a distance that shows nearly all of it."""
    import math

    import numpy as np

    from v3dg.cameras import DEFAULT_FOV_X, turntable
    from v3dg.gaussians import Gaussians

    if isinstance(subject, Gaussians):
        means = subject.means
    else:
        sizes = [level_size(subject, level) for level in range(subject.num_levels)]
        level = next((i for i, size in enumerate(sizes) if size <= _ENOUGH_TO_FRAME), len(sizes) - 1)
        means = subject.level_gaussians(level).means if sizes else np.zeros((0, 3), np.float32)
    # Trained assets have a few gaussians far away from all others.
    low, high = np.percentile(means, (1, 99), axis=0) if len(means) else (np.zeros(3), np.ones(3))
    centre = (low + high) / 2
    radius = max(float(np.linalg.norm(high - low)) / 2, 1e-6)
    narrow = math.tan(DEFAULT_FOV_X / 2) * min(1.0, options.size[1] / options.size[0])
    distance = 0.9 * radius / math.sin(math.atan(narrow))
    axis = np.eye(3)["xyz".index(options.up[-1])] * (-1 if options.up[0] == "-" else 1)
    cameras = turntable(
        centre,
        distance,
        options.views,
        math.radians(options.elevation),
        up=axis,
        width=options.size[0],
        height=options.size[1],
        near=min(0.01, 0.01 * distance),
    )
    digits = len(str(options.views - 1))
    return {f"{i:0{digits}}": camera for i, camera in enumerate(cameras)}


def _safe(name: str) -> str:
    """A camera's name as part of a file name."""
    return "".join(c if c.isalnum() or c in "-_." else "_" for c in name)
