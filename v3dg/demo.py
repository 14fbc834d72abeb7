"""The main job without a download: build a bundle, place it 2,000 times, draw it from near to far.

The result is one picture: the full asset above, the selected cut below, a column a distance, each with the
gaussians drawn, the time and the error to the full asset at twice the resolution, box-averaged: FLIP, or PSNR
where the extra `flip` is not installed.
"""

from __future__ import annotations

import os
import time
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from v3dg import _device
from v3dg._device import Device
from v3dg.build import BuildConfig, build_bundle
from v3dg.cameras import Camera
from v3dg.donut import make_donut, place_field
from v3dg.metrics import box_downsample, flip, has_flip, psnr
from v3dg.pictures import Picture, check_picture_path, contact_sheet, to_8bit, write_picture
from v3dg.render import render
from v3dg.scene import Scene
from v3dg.select import DEFAULT_TOLERANCE

if TYPE_CHECKING:
    from numpy.typing import NDArray

# Distance from the eye to the donut in the middle, in radii of a donut, and height of the view in radians.
VIEWS = ((3.3, 0.36), (8.0, 0.36), (20.0, 0.36), (46.0, 0.38), (95.0, 0.42))
SUPERSAMPLING = 2
AZIMUTH = 0.80  # rad; the sun is then behind the camera
SKY_TOP, SKY_BOTTOM = np.array([0.34, 0.55, 0.80]), np.array([0.86, 0.90, 0.91])


@dataclass(frozen=True)
class Panel:
    """One drawn picture's numbers."""

    gaussians: int  # in the frustum
    gaussians_selected: int
    select_ms: float
    draw_ms: float
    flip: float | None  # None where it is not installed
    psnr: float

    @property
    def milliseconds(self) -> float:
        """Select and draw."""
        return self.select_ms + self.draw_ms

    @property
    def error(self) -> tuple[str, float]:
        """What the pictures and the table show of the two measures, by its name."""
        return ("PSNR", self.psnr) if self.flip is None else ("FLIP", self.flip)


@dataclass(frozen=True)
class Column:
    """One distance: the full asset and the cut of the bundle."""

    distance: float
    full: Panel
    bundle: Panel


@dataclass(frozen=True)
class DemoResult:
    """What the demo made and measured."""

    picture: str
    asset_gaussians: int
    instances: int
    levels: int
    bundle_gaussians: int
    tolerance: float
    device: str  # of the CPU the number of threads, of the GPU its name
    build_seconds: float
    seconds: float
    columns: tuple[Column, ...]

    def as_dict(self) -> dict[str, Any]:
        """JSON values."""
        return asdict(self)


def view_camera(distance: float, elevation: float, width: int, height: int) -> Camera:
    """Look at the middle of the field: from near at a donut, from far at the whole hill."""
    near = 1 / (1 + (distance / 12) ** 2)
    target = np.array([0.0, 0.0, 0.42 * near])
    direction = np.array(
        [
            np.sin(AZIMUTH) * np.cos(elevation),
            -np.cos(AZIMUTH) * np.cos(elevation),
            np.sin(elevation),
        ]
    )
    return Camera.look_at(target + distance * direction, target, width=width, height=height)


def _sky(height: int, width: int) -> NDArray[np.float64]:
    ramp = np.linspace(0, 1, height)[:, None, None] ** 0.8
    return np.broadcast_to(SKY_TOP * (1 - ramp) + SKY_BOTTOM * ramp, (height, width, 3))


def _over_sky(color: Any, alpha: Any) -> NDArray[np.float32]:
    picture = color + (1 - alpha[..., None]) * _sky(*alpha.shape)
    clipped: NDArray[np.float32] = np.clip(picture, 0, 1).astype(np.float32)
    return clipped


def run_demo(
    output: str | os.PathLike[str] = "v3dg_demo.png",
    *,
    num_gaussians: int = 50_000,
    instances: int = 2000,
    size: tuple[int, int] = (380, 440),
    tolerance: float = DEFAULT_TOLERANCE,
    seed: int = 0,
    config: BuildConfig | None = None,
    views: tuple[tuple[float, float], ...] = VIEWS,
    progress: bool = True,
    device: str = "auto",
) -> DemoResult:
    """Make an asset, build and place it, draw and measure every distance, and write the picture.

    Args:
        num_gaussians: Of the asset.
        size: Width and height of one panel in px.
        views: Distance and elevation of every column.
        device: Where to build and draw: "auto", "cpu" or "cuda".

    Raises:
        ValueError: The picture cannot be written to ``output``, or an argument is out of range.
    """
    from tqdm import tqdm

    path = check_picture_path(output)
    where = _device.resolve(device)
    start = time.perf_counter()
    asset = make_donut(num_gaussians, seed=seed)
    built = time.perf_counter()
    bundle = build_bundle(asset, config=config or BuildConfig(), seed=seed, progress=progress, device=where)
    build_seconds = time.perf_counter() - built
    scene = Scene()
    positions, quaternions, scales = place_field(instances, seed=seed)
    scene.add(bundle, positions=positions, quaternions=quaternions, scales=scales)

    columns, pictures = [], []
    for distance, elevation in tqdm(views, "draw", unit="distance", leave=False, disable=not progress):
        camera = view_camera(distance, elevation, *size)
        truth = _truth(scene, camera, where)
        full, full_picture = _measure(scene, camera, 0.0, truth, where)
        ours, our_picture = _measure(scene, camera, tolerance, truth, where)
        columns.append(Column(distance, full, ours))
        pictures.append((full_picture, our_picture))

    result = DemoResult(
        picture=str(path),
        asset_gaussians=len(asset),
        instances=instances,
        levels=bundle.num_levels,
        bundle_gaussians=bundle.num_gaussians,
        tolerance=tolerance,
        device=f"{_num_threads()} CPU threads" if not where.is_cuda else _device.describe(where),
        build_seconds=build_seconds,
        seconds=time.perf_counter() - start,
        columns=tuple(columns),
    )
    write_picture(path, _sheet(columns, pictures))
    return result


def _truth(scene: Scene, camera: Camera, device: Device) -> NDArray[np.float32]:
    """The full asset at twice the resolution, box-averaged."""
    sharp = render(scene, camera.scaled(SUPERSAMPLING), tolerance=0.0, device=device)
    planes = (_device.to_host(plane) for plane in (sharp.color, sharp.alpha))
    return _over_sky(*(box_downsample(plane, SUPERSAMPLING) for plane in planes))


def _measure(
    scene: Scene, camera: Camera, tolerance: float, truth: NDArray[np.float32], device: Device
) -> tuple[Panel, NDArray[np.float32]]:
    image = render(scene, camera, tolerance=tolerance, device=device)
    picture = _over_sky(_device.to_host(image.color), _device.to_host(image.alpha))
    stats = image.stats
    panel = Panel(
        gaussians=stats.gaussians_in_frustum,
        gaussians_selected=stats.gaussians_selected,
        select_ms=stats.select_ms,
        draw_ms=stats.draw_ms,
        flip=flip(truth, picture) if has_flip() else None,
        psnr=psnr(truth, picture),
    )
    return panel, picture


def _num_threads() -> int:
    """CPU threads that OpenMP takes."""
    wanted = os.environ.get("OMP_NUM_THREADS", "").split(",")[0]
    return int(wanted) if wanted.isdigit() and int(wanted) else len(os.sched_getaffinity(0))


def count_text(count: int) -> str:
    """A count to three digits: 940, 12.3 k, 4.56 M."""
    for factor, unit in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if count >= factor:
            value = count / factor
            return f"{value:.{2 if value < 10 else 1 if value < 100 else 0}f}{unit}"
    return str(count)


def time_text(milliseconds: float) -> str:
    """A time to two or three digits: 34 ms, 1.25 s."""
    return (
        f"{milliseconds:.0f} ms"
        if milliseconds < 1000
        else f"{milliseconds / 1000:.{2 if milliseconds < 9995 else 1}f} s"
    )


def table_text(result: DemoResult) -> str:
    """The numbers of the picture as a table."""
    error = result.columns[0].full.error[0]
    lines = [
        f"{result.instances:,} instances of {result.asset_gaussians:,} gaussians, "
        f"{result.levels} levels built in {result.build_seconds:.1f} s, tolerance {result.tolerance:g} px²",
        "",
        f"{'':>9} {'full asset':-^34}  {'v3dg':-^34}",
        f"{'distance':>9}" + f" {'gaussians':>10} {'select+draw':>12} {error:>10} " * 2,
    ]
    for column in result.columns:
        cells = (
            f" {count_text(p.gaussians):>10} {time_text(p.milliseconds):>12} {p.error[1]:>10.4f} "
            for p in (column.full, column.bundle)
        )
        lines.append(f"{column.distance:>9g}" + "".join(cells))
    return "\n".join(line.rstrip() for line in lines)


def _sheet(columns: list[Column], pictures: list[tuple[Any, Any]]) -> Picture:
    """The full asset in the upper row, the bundle in the lower one, each picture below its numbers."""

    def text(name: str, column: Column, panel: Panel) -> str:
        error, value = panel.error
        cost = (
            f"{count_text(panel.gaussians)} gaussians, {time_text(panel.milliseconds)}, {error} {value:.3f}"
        )
        return f"{name}, distance {column.distance:g}: {cost}"

    rows = zip(columns, pictures, strict=True)
    cells = [
        ((text("full", c, c.full), to_8bit(full)), (text("v3dg", c, c.bundle), to_8bit(ours)))
        for c, (full, ours) in rows
    ]
    return contact_sheet([[upper for upper, _ in cells], [lower for _, lower in cells]])
