"""Results of a version of v3dg as digests, and their times, for a comparison of two
versions.

Run it one or more times with each version, in alternation on one machine, and then
compare the outputs:

    PYTHONPATH=old python -m benchmarks.studies.two_versions --output old.json ...
    PYTHONPATH=new python -m benchmarks.studies.two_versions --output new.json ...
    python -m benchmarks.studies.two_versions --compare old.json new.json

The study uses only the public interface, so that it also runs with versions whose
modules are organised differently.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import statistics
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import v3dg


def host(array: Any) -> np.ndarray[Any, Any]:
    return array if isinstance(array, np.ndarray) else array.detach().cpu().numpy()


def digest(*arrays: Any) -> str:
    """Return a digest of the bytes of arrays."""
    found = hashlib.blake2b(digest_size=8)
    for array in arrays:
        found.update(np.ascontiguousarray(host(array)).tobytes())
    return found.hexdigest()


def random_gaussians(count: int, sh_degree: int, seed: int = 0) -> v3dg.Gaussians:
    """Return gaussians in a ball, with the sizes that training gives."""
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(count, 3))
    means *= rng.random((count, 1)) ** (1 / 3) / np.linalg.norm(means, axis=1, keepdims=True)
    scales = np.exp(rng.normal(np.log(0.7 * count ** (-1 / 3)), 0.5, (count, 3)))
    return v3dg.Gaussians(
        means.astype(np.float32),
        rng.normal(size=(count, 4)).astype(np.float32),
        scales.astype(np.float32),
        rng.uniform(0.05, 1, count).astype(np.float32),
        (0.4 * rng.normal(size=(count, (sh_degree + 1) ** 2, 3))).astype(np.float32),
    )


class Run:
    """The digests and times of one version on one device."""

    def __init__(self, device: str, repeats: int) -> None:
        self.device, self.repeats = device, repeats
        self.digests: dict[str, str] = {}
        self.ms: dict[str, list[float]] = {}

    def wait(self) -> None:
        if self.device == "cuda":
            import torch

            torch.cuda.synchronize()

    def time(self, name: str, call: Any, repeats: int | None = None) -> Any:
        result = call()
        self.wait()
        for _ in range(repeats or self.repeats):
            start = time.perf_counter()
            result = call()
            self.wait()
            self.ms.setdefault(name, []).append(1e3 * (time.perf_counter() - start))
        return result

    def builds(self) -> v3dg.Bundle:
        for sh_degree, config in (
            (0, v3dg.BuildConfig(steps=40)),
            (2, v3dg.BuildConfig(steps=20, init="prune", targets="previous")),
            (3, v3dg.BuildConfig.paper(cluster_size=512, steps=10)),
        ):
            asset = random_gaussians(6000, sh_degree, seed=sh_degree)
            bundle = v3dg.build_bundle(
                asset, config=config, seed=5, device=self.device, progress=False, quality="draft"
            )
            self.digests[f"build sh {sh_degree}"] = self.digest_of(bundle)
        asset = random_gaussians(40_000, 1)
        config = v3dg.BuildConfig(steps=100 if self.device == "cpu" else 800)
        build = partial(
            v3dg.build_bundle,
            asset,
            config=config,
            device=self.device,
            progress=False,
            quality="draft",
        )
        bundle = self.time("build 40 k", build, 1 if self.device == "cpu" else 5)
        self.digests["build 40 k"] = self.digest_of(bundle)
        return bundle

    @staticmethod
    def digest_of(bundle: v3dg.Bundle) -> str:
        g, c, p = bundle.gaussians, bundle.clusters, bundle.groups
        tables = c.offset, c.own_group, c.parent_group, c.box, p.ball, p.weight, p.error
        return digest(g.means, g.quats, g.scales, g.opacities, g.sh, *tables)

    def frames(self, name: str, scene: Any, cameras: dict[str, v3dg.Camera]) -> None:
        for key, camera in cameras.items():
            for tolerance in (0.0, 3.0, 9.4):
                label = f"{name} {key} tolerance {tolerance:g}"
                options = {"tolerance": tolerance, "device": self.device}
                choose = partial(v3dg.select, scene, camera, **options)
                cut = self.time(f"select, {label}", choose)
                self.digests[f"cut, {label}"] = digest(cut.instance_ids, cut.cluster_ids)
                if tolerance == 0.0 and self.device == "cpu":
                    continue
                image = self.time(f"frame, {label}", partial(v3dg.render, scene, camera, **options))
                self.digests[f"picture, {label}"] = digest(image.color, image.alpha)
            budget = (
                v3dg.select(scene, camera, tolerance=3.0, device=self.device).num_gaussians // 2
            )
            cut = v3dg.select(scene, camera, budget=budget, device=self.device)
            self.digests[f"budget, {name} {key}"] = digest(cut.instance_ids, cut.cluster_ids)
            world = cut.gaussians(origin=camera.position, device=self.device)
            self.digests[f"world, {name} {key}"] = digest(
                world.means, world.quats, world.scales, world.opacities
            )
        if self.device == "cuda":
            self.host_part(name, scene, next(iter(cameras.values())))

    def host_part(self, name: str, scene: Any, camera: v3dg.Camera) -> None:
        """Record the time until a frame is enqueued, without the time of the device."""
        renderer = v3dg.Renderer(scene)
        for _ in range(20):
            renderer.render(camera, tolerance=9.4).stats  # noqa: B018
        found = []
        for _ in range(200):
            self.wait()
            start = time.perf_counter()
            image = renderer.render(camera, tolerance=9.4)
            found.append(1e3 * (time.perf_counter() - start))
            image.stats  # noqa: B018
        self.ms[f"host, {name}"] = found

    def rasterize(self, count: int, sh_degree: int, width: int, height: int) -> None:
        import torch

        camera = v3dg.Camera.look_at((0.2, -2.5, 0.3), (0, 0, 0), width=width, height=height)
        asset = random_gaussians(count, sh_degree, seed=1)
        tensors = asset.torch(self.device)
        names = ("means", "quats", "scales", "opacities", "sh")
        leaves = [getattr(tensors, name).clone().requires_grad_() for name in names]
        forward = lambda: v3dg.rasterize(tensors, camera, filter_px2=0.3, antialiased=True)  # noqa: E731
        image = self.time(f"forward {count}", forward)
        self.digests[f"forward {count}"] = digest(image.color, image.alpha, image.depth)
        weights = torch.linspace(0.1, 1.0, 3, device=self.device)

        def both() -> Any:
            for leaf in leaves:
                leaf.grad = None
            picture = v3dg.rasterize(
                v3dg.Gaussians(*leaves), camera, filter_px2=0.3, antialiased=True
            )
            ((picture.color * weights).mean() + 0.1 * picture.alpha.mean()).backward()
            return leaves

        self.time(f"forward + backward {count}", both)
        # The sign of a zero gradient may differ between runs of the same version;
        # adding 0 makes it positive.
        self.digests[f"gradients {count}"] = digest(*(leaf.grad + 0.0 for leaf in leaves))


def compare(old_path: Path, new_path: Path, output: Path | None) -> int:
    """Print the differences, and write them to `output` if it is given; return the
    number of digests that differ."""
    old, new = (json.loads(path.read_text()) for path in (old_path, new_path))
    names = sorted(old["digests"].keys() | new["digests"].keys())
    differ = [name for name in names if old["digests"].get(name) != new["digests"].get(name)]
    print(
        f"{len(names) - len(differ)} of {len(names)} digests are equal; different ones: "
        f"{differ or 'none'}"
    )
    times = {}
    print(f"{'':58} {'old ms':>9} {'new ms':>9} {'ratio':>6} {'least':>6}")
    for name, before in old["ms"].items():
        after = new["ms"].get(name)
        if after is None:
            continue
        middle = statistics.median(before), statistics.median(after)
        times[name] = {
            "old_ms": [round(middle[0], 4), round(min(before), 4)],
            "new_ms": [round(middle[1], 4), round(min(after), 4)],
        }
        print(
            f"{name:58} {middle[0]:9.3f} {middle[1]:9.3f} {middle[1] / middle[0]:6.3f} "
            f"{min(after) / min(before):6.3f}"
        )
    if output:
        about = {"old": old["machine"], "new": new["machine"], "times": "median and least, ms"}
        same = {"digests": len(names), "differ": differ}
        output.write_text(json.dumps({**about, **same, "ms": times}, indent=1) + "\n")
    return len(differ)


def machine(device: str, commit: str) -> dict[str, Any]:
    names = [
        line
        for line in Path("/proc/cpuinfo").read_text().splitlines()
        if line.startswith("model name")
    ]
    about = {
        "commit": commit,
        "command": " ".join(Path(word).name if os.sep in word else word for word in sys.argv),
        "processor": names[0].split(":", 1)[1].strip() if names else platform.processor(),
        "cores": os.cpu_count(),
        "isa": v3dg._core.isa(),
    }
    if device == "cuda":
        import torch

        about |= {"gpu": torch.cuda.get_device_name(), "cuda": str(torch.version.cuda)}
    return about


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument(
        "--layout", type=Path, help="layout of instances, for frames of a whole scene"
    )
    parser.add_argument("--cameras", type=int, nargs="*", default=[40, 46, 50, 59])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument(
        "--count", type=int, default=100_000, help=("number of gaussians to rasterize")
    )
    parser.add_argument(
        "--output",
        type=Path,
        help=("JSON file for the results; results are added to an existing file"),
    )
    parser.add_argument(
        "--commit", default="", help=("commit of the measured version, recorded in the results")
    )
    parser.add_argument("--compare", type=Path, nargs=2, metavar=("OLD", "NEW"))
    arguments = parser.parse_args()
    if arguments.compare:
        raise SystemExit(compare(*arguments.compare, arguments.output) != 0)
    run = Run(arguments.device, arguments.repeats)
    if arguments.output and arguments.output.is_file():
        run.ms = json.loads(arguments.output.read_text())["ms"]
    bundle = run.builds()
    ring = {
        f"ring {k}": c
        for k, c in enumerate(v3dg.cameras.turntable((0, 0, 0), 4.0, 2, width=640, height=480))
    }
    run.frames("random", bundle, ring)
    if arguments.layout:
        from v3dg import read_scene

        # Older versions call the function `load`.
        read_asset = getattr(v3dg, "read_asset", None) or v3dg.load
        asset = read_asset(
            arguments.layout.parent / json.loads(arguments.layout.read_text())["asset"]
        )
        config = v3dg.BuildConfig(steps=20)
        name = json.loads(arguments.layout.read_text())["asset"]
        donut = v3dg.build_bundle(
            asset, config=config, device=arguments.device, progress=False, quality="draft"
        )
        scene, cameras = read_scene(arguments.layout, bundles={name: donut})
        some = [list(cameras.items())[k] for k in arguments.cameras]
        run.frames(
            "layout",
            scene,
            {f"camera {k}": c for k, (_, c) in zip(arguments.cameras, some, strict=True)},
        )
    run.rasterize(arguments.count, 3 if arguments.device == "cuda" else 1, 1280, 720)
    if arguments.output:
        arguments.output.write_text(
            json.dumps(
                {
                    "machine": machine(arguments.device, arguments.commit),
                    "digests": run.digests,
                    "ms": run.ms,
                },
                indent=1,
            )
        )


if __name__ == "__main__":
    main()
