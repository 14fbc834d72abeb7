"""Frames drawn from quantised codes in comparison with frames drawn from float32 rows,
on a GPU.

    python -m benchmarks.studies.code_frames donut.ply donutsea.json NAME=OTHER.ply

For the scene and for each asset alone, the study measures bytes on the GPU per stored
gaussian; frame times of the device and of the wall clock, with the kinds of bundles in
alternation; and times of the project stage. It also checks whether pictures from codes
have the same bits as pictures of a float32 bundle with the decoded rows, and measures
their difference from pictures of the original bundle.
docs/notes/experiments/2026-11-22-codecs-drawing.md has results.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro

import v3dg
from benchmarks.evaluation.assets import read_layout
from v3dg import Bundle, Renderer, Scene, _device
from v3dg.residency import residency

DEVICE = "cuda:0"


@dataclass
class Config:
    asset: tyro.conf.Positional[Path]
    layout: tyro.conf.Positional[Path]
    more: tyro.conf.Positional[tuple[str, ...]] = ()
    """More assets, each as NAME=FILE."""
    rounds: int = 30
    """Number of frames of each bundle in each view."""
    decodes_once: bool = False
    """Whether small bundles are decoded once, as renderers do by default; otherwise
    every bundle is drawn from codes."""


def memory():
    torch.cuda.synchronize()
    free, total = torch.cuda.mem_get_info(0)
    return total - free


def kinds_of(gaussians):
    """Return three bundles by name: float32 as built, its quantised codes, and the
    decoded codes as float32."""
    built = v3dg.build_bundle(gaussians, device=DEVICE, progress=False, quality="draft")
    codes = Bundle(built.clusters, built.groups, built.gaussians, codec="quantized")
    rows = Bundle(codes.clusters, codes.groups, codes.gaussians)
    return {"float32": built, "quantized": codes, "decoded": rows}


def bytes_of(bundle):
    residency.clear()
    torch.cuda.empty_cache()
    before = memory()
    model, table = residency.model(bundle, _device.resolve(DEVICE)), residency.table(bundle)
    # The tables are copied to the device.
    placed = residency.scene(bundle, _device.resolve(DEVICE))
    resident = model.bytes + table.bytes_on(0)
    done = {
        "bytes": resident,
        "bytes_a_gaussian": resident / bundle.num_gaussians,
        "driver_bytes_a_gaussian": (memory() - before) / bundle.num_gaussians,
        "clusters": len(bundle.clusters),
        "gaussians": bundle.num_gaussians,
        "file_bytes_a_leaf": bundle.info()["bytes"] / bundle.info()["levels"][0]["gaussians"],
    }
    del placed
    return done


def frame_ms(renderer, camera, options):
    start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    torch.cuda.synchronize()
    wall = time.perf_counter()
    start.record()
    image = renderer.render(camera, **options)
    end.record()
    torch.cuda.synchronize()
    wall = 1e3 * (time.perf_counter() - wall)
    image.stats  # noqa: B018
    return start.elapsed_time(end), wall


def project_ms(renderer, camera, options):
    from torch.profiler import ProfilerActivity, profile

    frames = 5
    with profile(activities=[ProfilerActivity.CUDA]) as trace:
        for _ in range(frames):
            renderer.render(camera, **options).stats  # noqa: B018
        torch.cuda.synchronize()
    total = sum(
        e.time_range.elapsed_us()
        for e in trace.events()
        if "project" in e.name and "kernel" in e.name
    )
    return total / frames / 1e3


def compared(subjects, cameras, options, rounds):
    renderers = {name: Renderer(subject, device=DEVICE) for name, subject in subjects.items()}
    result = []
    for camera in cameras:
        images = {name: r.render(camera, **options) for name, r in renderers.items()}
        stats = {name: image.stats for name, image in images.items()}
        color = {name: image.color.double() for name, image in images.items()}
        mse = float(((color["quantized"] - color["float32"]) ** 2).mean())
        equal = all(
            torch.equal(getattr(images["quantized"], p), getattr(images["decoded"], p))
            for p in ("color", "alpha", "depth")
        )
        for _ in range(3):
            for r in renderers.values():
                frame_ms(r, camera, options)
        times = {"float32": [], "quantized": []}
        for k in range(rounds):
            for name in sorted(times, reverse=bool(k % 2)):
                times[name].append(frame_ms(renderers[name], camera, options))
        device = {name: np.array([t[0] for t in of]) for name, of in times.items()}
        wall = {name: np.array([t[1] for t in of]) for name, of in times.items()}
        result.append(
            {
                "options": {k: v for k, v in options.items()},
                "gaussians": {name: s.gaussians_selected for name, s in stats.items()},
                "in_frustum": {name: s.gaussians_in_frustum for name, s in stats.items()},
                "device_ms": {name: float(np.median(t)) for name, t in device.items()},
                "wall_ms": {name: float(np.median(t)) for name, t in wall.items()},
                "ratio": float(np.median(device["quantized"] / device["float32"])),
                "project_ms": {
                    name: project_ms(renderers[name], camera, options) for name in times
                },
                "psnr_to_float32": None if mse == 0 else -10 * np.log10(mse),
                "most_difference": float((color["quantized"] - color["float32"]).abs().max()),
                "same_bits_as_decoded": equal,
            }
        )
    return result


def views_of(gaussians):
    """Return cameras around an asset, at distances of 1, 2.5 and 8 radii of the ball
    that contains 90 % of its gaussians."""
    means = np.asarray(gaussians.means, np.float64)
    centre = np.median(means, axis=0)
    radius = float(np.quantile(np.linalg.norm(means - centre, axis=1), 0.9))
    return [
        v3dg.Camera.look_at(
            centre + d * radius * np.array([0.3, -1, 0.4]),
            centre,
            (0, 0, 1),
            0.9,
            width=1920,
            height=1080,
        )
        for d in (1, 2.5, 8)
    ]


def main(config):
    if not config.decodes_once:
        v3dg.residency.MOST_DECODED_BYTES = 0
    donut = v3dg.read_asset(config.asset)
    kinds = kinds_of(donut)
    report = {
        "device": torch.cuda.get_device_name(0),
        "bytes": {"donut": {name: bytes_of(kinds[name]) for name in ("float32", "quantized")}},
    }
    degree3 = v3dg.Gaussians(
        donut.means,
        donut.quats,
        donut.scales,
        donut.opacities,
        np.concatenate(
            [donut.sh[:, :1], np.random.default_rng(0).normal(0, 0.1, (len(donut), 15, 3))], 1
        ).astype(np.float32),
    )
    made = {"donut, random coefficients of degree 3": degree3}
    for pair in config.more:
        name, path = pair.split("=", 1)
        made[name] = v3dg.read_asset(path)
    scene_of, cameras = {}, {}
    for name, bundle in kinds.items():
        scene_of[name], cameras = read_layout(config.layout, bundle)
    residency.clear()
    views = list(cameras.values())
    picked = views[:: max(1, len(views) // 6)][:6] + views[-1:]
    report["scene"] = {}
    for tolerance in (3.0, 9.4):
        rows = compared(scene_of, picked, {"tolerance": tolerance}, config.rounds)
        report["scene"][str(tolerance)] = {
            "ratio": float(np.median([r["ratio"] for r in rows])),
            "views": rows,
        }
    report["scene"]["all leaves"] = compared(
        scene_of, views[-1:], {"tolerance": 1e-6}, config.rounds
    )
    one = Scene()
    one.add(kinds["float32"], positions=(0.0, 0, 0))
    one.add(kinds["quantized"], positions=(0.5, 0, 0))
    other = Scene()
    other.add(kinds["float32"], positions=(0.0, 0, 0))
    other.add(kinds["decoded"], positions=(0.5, 0, 0))
    camera = v3dg.Camera.look_at((0, -1, 0.5), (0.2, 0, 0), (0, 0, 1), 0.9, width=1280, height=720)
    pair = [v3dg.render(scene, camera, device=DEVICE) for scene in (one, other)]
    report["mixed_scene_same_bits"] = bool(torch.equal(pair[0].color, pair[1].color))
    report["assets"] = {}
    for name, gaussians in made.items():
        of = kinds_of(gaussians)
        report["bytes"][name] = {kind: bytes_of(of[kind]) for kind in ("float32", "quantized")}
        report["assets"][name] = compared(of, views_of(gaussians), {}, config.rounds)
        residency.clear()
    json.dump(report, sys.stdout, indent=1)
    print()


if __name__ == "__main__":
    main(tyro.cli(Config))
