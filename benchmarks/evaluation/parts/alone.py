"""Rasterizer, split, selection and build, each measured alone: time, fraction of the
hardware's limit, and growth with the number of gaussians."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import time
from dataclasses import fields
from typing import Any

import numpy as np

from benchmarks.evaluation import gpu
from benchmarks.evaluation.assets import like_trained, many_copies
from benchmarks.evaluation.evaluation import Evaluation
from benchmarks.evaluation.markdown import Column, count_text, markdown
from benchmarks.evaluation.measure import Row, time_ms
from benchmarks.evaluation.summary import Summary
from v3dg import _core, _device
from v3dg.cameras import Camera
from v3dg.gaussians import Gaussians
from v3dg.levels import BuildConfig
from v3dg.metrics import psnr
from v3dg.pictures import to_8bit
from v3dg.render import Renderer, render
from v3dg.scene import Scene
from v3dg.select import DEFAULT_TOLERANCE, select

TITLE = "Rasterizer, split, selection, build alone"
ABOUT = (
    "Random gaussians of the sizes that training leaves. Share is that of the machine's speed of "
    "copying memory, if every input were read and every output written once; the rasterizer's "
    "picture is checked against double precision (a small one on the CPU) or against gsplat, in "
    "the same run, before its time counts."
)

_COPIED_BYTES = 256 << 20
_MOST_BUILT = {"cpu": 20_000, "cuda": 1_000_000}
_MOST_DRAWN = {"cpu": 1_000_000, "cuda": 100_000_000}
_LEAST_PSNR = 40.0


def run(evaluation: Evaluation) -> dict[str, Any]:
    bandwidth = copy_bandwidth(evaluation.device)
    counts = evaluation.settings.counts
    most_drawn, most_built = _MOST_DRAWN[evaluation.device], _MOST_BUILT[evaluation.device]
    return {
        "copy_gigabytes_a_second": round(bandwidth / 1e9, 2),
        "rasterize": [rasterize_row(evaluation, n, bandwidth) for n in counts if n <= most_drawn],
        "split": [split_row(evaluation, n, bandwidth) for n in counts],
        "select": [select_row(evaluation, n) for n in counts],
        "build": [build_row(evaluation, n) for n in counts if n <= most_built],
        "threads": threads_rows(evaluation) if evaluation.device == "cpu" else [],
    }


def copy_bandwidth(device: str) -> float:
    """Return the bandwidth of one large copy: bytes read plus bytes written, per
    second."""
    source = np.ones(_COPIED_BYTES, np.uint8)
    if device == "cpu":
        target = np.empty_like(source)
        copied = time_ms(lambda: np.copyto(target, source), device, 5)
    else:
        import torch

        on_device = torch.from_numpy(source).to(device)
        result = torch.empty_like(on_device)
        copied = time_ms(lambda: result.copy_(on_device), device, 5)
    return 2 * _COPIED_BYTES / (copied.median / 1e3)


def rasterize_row(evaluation: Evaluation, count: int, bandwidth: float) -> Row:
    width, height = evaluation.settings.size
    camera = Camera.look_at((0, 0, 0), (0, 1, 0), width=width, height=height)
    gaussians = like_trained(count, camera, evaluation.device, seed=evaluation.seed)

    def draw() -> Any:
        return render(gaussians, camera, device=evaluation.device)

    picture = draw()
    row: Row = {"gaussians": count, "gaussians_in_frustum": picture.stats.gaussians_in_frustum}
    if evaluation.device == "cuda" and gpu.has_gsplat():
        row |= gsplat_peer(evaluation, gaussians, camera, picture.color)
    elif evaluation.device == "cpu":
        row["psnr_to_float64"] = psnr_to_float64(gaussians, camera, picture.color)
    # The asset is converted to the renderer's layout once.
    renderer = Renderer(gaussians, device=evaluation.device)
    timed = time_ms(
        lambda: renderer.render(camera).stats, evaluation.device, evaluation.settings.repeats
    )
    row |= timed.row("frame")
    num_bytes = 4 * (
        sum(math.prod(getattr(gaussians, f.name).shape) for f in fields(gaussians))
        + 5 * width * height
    )
    row |= {"bytes": num_bytes, "share": round(num_bytes / (timed.median / 1e3) / bandwidth, 4)}
    return row


def psnr_to_float64(gaussians: Gaussians, camera: Camera, color: Any) -> float:
    rows = _core.Rows(*(getattr(gaussians, f.name).astype(np.float64) for f in fields(gaussians)))
    exact = _core.rasterize(
        rows,
        camera.core,
        filter_px2=0.0,
        antialiased=False,
        background=[0.0] * 3,
        with_depth=False,
        keep_tape=False,
    ).color
    return _checked_psnr(exact.astype(np.float32), color)


def _checked_psnr(expected: Any, color: Any) -> float:
    found = psnr(*(to_8bit(c).astype(np.float32) / 255 for c in (expected, color)))
    if not found >= _LEAST_PSNR:
        raise RuntimeError(
            f"picture: expected a PSNR of at least {_LEAST_PSNR:g} dB against the reference, got "
            f"{found:.1f} dB"
        )
    return round(min(found, 99.0), 2)


def gsplat_peer(evaluation: Evaluation, gaussians: Gaussians, camera: Camera, color: Any) -> Row:
    import torch

    with torch.no_grad():
        expected = gpu.gsplat_picture(gaussians, camera, packed=True)[0]
    row: Row = {"psnr_to_gsplat": _checked_psnr(expected, color)}
    row |= gpu.time_gsplat(gaussians, camera, evaluation.settings.repeats).row("gsplat")
    torch.cuda.empty_cache()
    return row


def split_row(evaluation: Evaluation, count: int, bandwidth: float) -> Row:
    means: Any = np.random.default_rng(evaluation.seed).standard_normal((count, 3), np.float32)
    on_device = means
    ends, depth = np.array([0, count]), _core.num_halvings(count, BuildConfig().cluster_size)
    if evaluation.device == "cuda":
        import torch

        on_device = torch.from_numpy(means).to(evaluation.device)
        if count <= 1_000_000:
            order, _ = _core.median_split(on_device, ends, depth)
            if not np.array_equal(
                _device.to_host(order), _core.median_split(means, ends, depth)[0]
            ):
                raise RuntimeError(
                    "median_split: expected the same order on both devices, got different ones"
                )
    timed = time_ms(
        lambda: _core.median_split(on_device, ends, depth),
        evaluation.device,
        evaluation.settings.repeats,
    )
    num_bytes = (12 + 8) * count
    share = num_bytes / (timed.median / 1e3) / bandwidth
    return {"points": count, **timed.row("split"), "bytes": num_bytes, "share": round(share, 4)}


def select_row(evaluation: Evaluation, count: int) -> Row:
    """Return the row of a scene with this many gaussians. The distance is such that
    about half of the gaussians are drawn from coarser levels."""
    bundle = evaluation.build().bundle
    instances = max(1, count // len(evaluation.asset))
    rng = np.random.default_rng(evaluation.seed)
    side = 2.0 * instances**0.5
    positions = np.column_stack([rng.uniform(-side, side, (instances, 2)), np.zeros(instances)])
    scene = Scene()
    scene.add(bundle, positions=positions)
    camera = Camera.look_at((0, -2.0 * side, side), (0, 0, 0), width=1920, height=1080)

    def choose() -> Any:
        return select(scene, camera, tolerance=DEFAULT_TOLERANCE, device=evaluation.device)

    chosen = choose()
    timed = time_ms(choose, evaluation.device, evaluation.settings.repeats)
    clusters = instances * len(bundle.clusters)
    return {
        "gaussians": instances * len(evaluation.asset),
        "instances": instances,
        "clusters": clusters,
        "clusters_selected": len(chosen),
        **timed.row("select"),
        "clusters_a_second": round(clusters / (timed.median / 1e3)),
    }


def build_row(evaluation: Evaluation, count: int) -> Row:
    copies = -(-count // len(evaluation.asset))
    asset = many_copies(evaluation.asset, copies, seed=evaluation.seed).subset(slice(count))
    start = time.perf_counter()
    bundle = evaluation.build(BuildConfig(steps=evaluation.settings.large_steps), asset).bundle
    seconds = time.perf_counter() - start
    return {
        "gaussians": count,
        "steps": evaluation.settings.large_steps,
        "levels": bundle.num_levels,
        "seconds": round(seconds, 3),
        "gaussians_a_second": round(count / seconds),
        "mean_color_error": round(float(bundle.groups.error[:, 0].mean()), 5)
        if len(bundle.groups)
        else None,
    }


# Each number of threads needs a separate process, because OpenMP reads the number only
# once. The script prints the milliseconds of a split and of a frame. It uses the module
# path of this process, because the working directory may contain another v3dg.
_SCRIPT = """
import json, sys
sys.path[:] = json.loads(sys.argv[1])
import numpy as np
from v3dg import _core
from benchmarks.evaluation.assets import like_trained
from benchmarks.evaluation.measure import time_ms
from v3dg.cameras import Camera
from v3dg.render import render
count, width, height = map(int, sys.argv[2:])
camera = Camera.look_at((0, 0, 0), (0, 1, 0), width=width, height=height)
gaussians = like_trained(count, camera, "cpu")
ends, depth = np.array([0, count]), _core.num_halvings(count, 256)
times = {
    "frame_ms": time_ms(lambda: render(gaussians, camera), "cpu", 5).median,
    "split_ms": time_ms(lambda: _core.median_split(gaussians.means, ends, depth), "cpu", 5).median,
}
print(json.dumps(times))
"""


def threads_rows(evaluation: Evaluation) -> list[Row]:
    cores = len(os.sched_getaffinity(0))
    numbers = sorted({1, *(2**k for k in range(1, 9) if 2**k <= cores), cores})
    count = min(max(evaluation.settings.counts), 100_000)
    rows = []
    for number in numbers:
        done = subprocess.run(
            [
                *(sys.executable, "-c", _SCRIPT, json.dumps(sys.path)),
                *map(str, (count, *evaluation.settings.size)),
            ],
            env={**os.environ, "OMP_NUM_THREADS": str(number)},
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        )
        rows.append({"threads": number, **json.loads(done.stdout)})
    for row in rows:
        row["frame_speedup"] = round(rows[0]["frame_ms"] / row["frame_ms"], 2)
        row["split_speedup"] = round(rows[0]["split_ms"] / row["split_ms"], 2)
    return rows


_TABLES = {
    "rasterize": (
        Column("gaussians", "gaussians", "count"),
        Column("in frustum", "gaussians_in_frustum", "count"),
        Column("rasterize ms", "frame_ms", ".3f"),
        Column("gsplat ms", "gsplat_ms", ".3f"),
        Column("PSNR to gsplat", "psnr_to_gsplat", ".1f"),
        Column("to float64", "psnr_to_float64", ".1f"),
        Column("share of copying", "share", ".1%"),
    ),
    "split": (
        Column("points", "points", "count"),
        Column("split ms", "split_ms", ".3f"),
        Column("share of copying", "share", ".1%"),
    ),
    "select": (
        Column("gaussians", "gaussians", "count"),
        Column("clusters", "clusters", "count"),
        Column("selected", "clusters_selected", "count"),
        Column("select ms", "select_ms", ".3f"),
        Column("clusters a second", "clusters_a_second", "count"),
    ),
    "build": (
        Column("gaussians", "gaussians", "count"),
        Column("steps", "steps"),
        Column("build s", "seconds", ".2f"),
        Column("gaussians a second", "gaussians_a_second", "count"),
        Column("colour error", "mean_color_error", ".4f"),
    ),
    "threads": (
        Column("threads", "threads"),
        Column("frame ms", "frame_ms", ".1f"),
        Column("x", "frame_speedup", ".2f"),
        Column("split ms", "split_ms", ".1f"),
        Column("x", "split_speedup", ".2f"),
    ),
}


def tables(result: dict[str, Any]) -> str:
    text = [f"Copying memory: {result['copy_gigabytes_a_second']:g} GB/s, read and written."]
    for name, columns in _TABLES.items():
        if rows := result[name]:
            shown = [c for c in columns if any(row.get(c.key) is not None for row in rows)]
            text.append(markdown(shown, rows))
    return "\n\n".join(text)


def summary(result: dict[str, Any]) -> Summary:
    out = Summary()
    for row in result["rasterize"]:
        if "gsplat_ms" in row:
            out.judge(
                row["frame_ms"] < row["gsplat_ms"],
                f"{count_text(row['gaussians'])} random gaussians take {row['frame_ms']:.2f} ms, "
                f"gsplat {row['gsplat_ms']:.2f} ms; the pictures are {row['psnr_to_gsplat']:.0f} "
                "dB apart",
            )
    return out


def plot(result: dict[str, Any], figure: Any) -> None:
    axes = figure.subplots()
    for name, key, count in (
        ("rasterize", "frame_ms", "gaussians"),
        ("rasterize", "gsplat_ms", "gaussians"),
        ("split", "split_ms", "points"),
        ("select", "select_ms", "gaussians"),
    ):
        rows = [row for row in result[name] if key in row]
        if rows:
            axes.plot(
                [r[count] for r in rows],
                [r[key] for r in rows],
                "o-",
                label=key.removesuffix("_ms"),
            )
    axes.set(xlabel="gaussians", ylabel="ms", xscale="log", yscale="log")
    axes.legend()
    axes.grid(alpha=0.3)
