"""`v3dg refine`."""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from v3dg import _device
from v3dg._files import make_folder
from v3dg._json import JsonObject
from v3dg.bundle import Bundle
from v3dg.cameras import Camera
from v3dg.cli import _common
from v3dg.cli._views import CameraFile
from v3dg.framing import frame_subject
from v3dg.levels.viewpoints import SeenFrom, text_of
from v3dg.metrics import MIN_TRANSMITTANCE, draw_truth
from v3dg.pictures import to_8bit
from v3dg.refine import refine_file
from v3dg.render import render
from v3dg.upright import direction_of, up_of

# The result is judged by pictures of these widths in px, for this number of cameras
# each.
_WIDTHS = (512, 128, 32)
_MOST_CAMERAS = 4
_NOTICED_DB = 0.05


@dataclass(kw_only=True)
class Refine(CameraFile, _common.OnDevice):
    """Make the levels of a bundle more similar to its asset. This takes much longer
    than building it. If it is interrupted, the same command continues after the last
    unit of a large asset."""

    bundle: tyro.conf.Positional[Path]
    """Bundle (.v3dg) that `v3dg build` wrote."""
    output: tyro.conf.Positional[Path]
    """Bundle to write (.v3dg)."""
    steps: Annotated[int, tyro.conf.arg(metavar="N")] = 30_000
    """Number of pictures of cuts that are compared with pictures of the asset. An asset
    of more than 4 million gaussians is refined in units, each with this number."""
    cameras: Annotated[Path | None, _common.option("PATH")] = None
    """File or folder of cameras, as for `v3dg render`, such as those of the asset's
    photographs. By default, cameras are chosen as --seen-from says."""
    seen_from: Annotated[SeenFrom, _common.option("{auto,outside,inside,both}")] = "auto"
    """Where pictures are taken from if no cameras are given. By default, this depends
    on the free space that the asset surrounds."""
    drop: Annotated[float, tyro.conf.arg(metavar="SHARE")] = 0.02
    """Fraction of a level's visibility that may be lost by dropping its least visible
    gaussians. 0 keeps all gaussians. Assets of faint gaussians, such as smoke, always
    keep all."""
    seed: int = 0
    """Seed of random numbers. The same seed gives the same file, byte for byte, on the
    same kind of device and for any number of threads."""


def run(options: Refine) -> None:
    _common.require_file(options.bundle, ".v3dg")
    _common.check_usage(
        str(options.output), options.output.suffix == ".v3dg", "a file name ending in .v3dg"
    )
    _common.check_output(options.output, options.bundle)
    make_folder(options.output)
    start = time.perf_counter()
    bundle = Bundle.open(options.bundle)
    refined = _refined_file(bundle, options)
    seconds = time.perf_counter() - start
    num_units = refined.config.get("refined", {}).get("units", 1)
    rows: list[JsonObject] = []
    if num_units == 1:  # else the pictures would need memory for the whole asset
        rows = list(_compared(bundle, refined, options))
    result = {
        "output": str(options.output),
        "steps": options.steps,
        "units": num_units,
        "seconds": seconds,
        "psnr": rows,
    }
    lines = [_summary(result, refined)]
    if rows:
        columns = [
            _common.Column("picture", "{width} x {width}"),
            _common.Column("PSNR before", "{before:.2f}"),
            _common.Column("after", "{after:.2f}"),
        ]
        lines += ["", *_common.table_lines(columns, rows), *_warning(rows)]
    _common.print_result(result, lines, as_json=options.json)


def _refined_file(bundle: Bundle, options: Refine) -> Bundle:
    """Write the refined bundle to a file, open the file, and return the bundle."""
    return refine_file(
        bundle,
        options.output,
        cameras=list(options.read().values()),
        seen_from=options.seen_from,
        steps=options.steps,
        drop=options.drop,
        seed=options.seed,
        device=options.device,
        progress=not options.quiet,
    )


def _summary(result: JsonObject, refined: Bundle) -> str:
    """Return a line of text with the numbers of pictures and units, and the time that
    the refinement took."""
    line = f"{result['output']}: {result['steps']:,} steps"
    if result["units"] > 1:
        line += f" for each of {result['units']} units and the levels above them"
    line += f", {result['seconds']:.1f} s"
    viewpoints = text_of(refined.config.get("refined", {}))
    if viewpoints:
        line += f", {viewpoints}"
    return line


def _compared(bundle: Bundle, refined: Bundle, options: Refine) -> Iterator[JsonObject]:
    """Yield the mean PSNR of pictures before and after the refinement, for each width
    from large to small."""
    cameras = list(options.read().values())[:_MOST_CAMERAS]
    up = direction_of(up_of(bundle)[0])
    framing = frame_subject(bundle)
    for width in _WIDTHS:
        views = framing.turntable(up, _MOST_CAMERAS, width, width)
        if cameras:
            views = [_resized(camera, width) for camera in cameras]
        errors: dict[str, list[float]] = {"before": [], "after": []}
        for view in views:
            truth = draw_truth(bundle, view, _device.resolve(options.device))
            for name, subject in (("before", bundle), ("after", refined)):
                image = render(
                    subject, view, device=options.device, min_transmittance=MIN_TRANSMITTANCE
                )
                difference = to_8bit(image.color).astype(np.float64) - truth
                errors[name].append(float(np.square(difference / 255).mean()))
        values = {name: _psnr(float(np.mean(parts))) for name, parts in errors.items()}
        yield {"width": width, **values}


def _resized(camera: Camera, width: int) -> Camera:
    """Return a camera with the same field of view for a picture of this width."""
    height = max(round(camera.height * width / camera.width), 1)
    scale = np.array([[width / camera.width], [height / camera.height], [1.0]])
    return replace(camera, K=camera.K * scale, width=width, height=height)


def _psnr(mean_square: float) -> float:
    return -10 * math.log10(max(mean_square, 1e-10))


def _warning(rows: list[JsonObject]) -> list[str]:
    """Return lines about the picture widths at which the result is worse. Without such
    widths, there are no lines."""
    worse = [str(row["width"]) for row in rows if row["after"] < row["before"] - _NOTICED_DB]
    if not worse:
        return []
    sizes = ", ".join(worse)
    advice = "use more --steps, and keep the original bundle"
    return ["", f"worse than before at {sizes} px: {advice}"]
