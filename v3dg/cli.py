"""Command line: parse, call, print. What the commands do is in the modules that they call.

Exit codes: 0 done, 1 failed, 2 wrong usage, 130 interrupted. Errors are one line on stderr, results go to
stdout.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import sys
import textwrap
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias, cast

import tyro

from v3dg._version import __version__

if TYPE_CHECKING:
    from v3dg.bundle import Bundle
    from v3dg.cameras import Camera
    from v3dg.gaussians import Gaussians
    from v3dg.scene import Scene

# Gaussians of the level that a turntable is centred on: enough to know where things are, quick to read.
_ENOUGH_TO_FRAME = 50_000


@dataclass
class Build:
    """Build a bundle from a trained asset."""

    asset: tyro.conf.Positional[Path]
    """Trained gaussians, a .ply file."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="PATH")] = None
    """Bundle to write; the asset's name with .v3dg if not given."""
    config: Literal["default", "paper"] = "default"
    """Settings to start from: ours, or those of the V3DG paper."""
    cluster_size: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Most gaussians in a cluster; the config's own if not given."""
    seed: int = 0
    """The same seed gives the same file, byte for byte, on the same kind of device."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to compute; auto is a CUDA device where there is one and torch can use it."""
    strict: bool = False
    """Refuse an asset with wrong values, instead of leaving out the gaussians that have them."""
    resume: bool = False
    """Continue an interrupted build from its last finished level."""
    threads: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """CPU threads; all if not given. The result does not depend on it."""
    json: bool = False
    """Print the result as JSON."""
    quiet: bool = False
    """Show no progress."""


@dataclass
class Info:
    """Describe an asset (.ply), a bundle (.v3dg) or a scene (.json)."""

    file: tyro.conf.Positional[Path]
    """File to describe."""
    json: bool = False
    """Print the description as JSON."""


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


@dataclass
class Demo:
    """Build an asset that v3dg makes itself, place it 2,000 times, draw it from near to far, measure."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="PATH")] = Path("v3dg_demo.png")
    """Picture to write, .png or .jpg."""
    gaussians: int = 50_000
    """Gaussians of the asset."""
    instances: int = 2000
    """How often it is placed."""
    size: Annotated[tuple[int, int], tyro.conf.arg(metavar="W H")] = (380, 440)
    """Width and height of one panel in px."""
    tolerance: Annotated[float | None, tyro.conf.arg(metavar="PX2")] = None
    """Screen area in px² that one gaussian of a coarser cluster may stand for."""
    seed: int = 0
    """Seed of the asset, of the meadow and of the build."""
    threads: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """CPU threads; all if not given."""
    json: bool = False
    """Print the numbers as JSON."""
    quiet: bool = False
    """Show no progress."""


@dataclass
class Bench:
    """Measure speed against error, beside peers, and write JSON, tables and pictures (docs/results.md)."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FOLDER")] = Path("v3dg_bench")
    """Folder for the results; made if it is not there."""
    preset: Literal["small", "full"] = "small"
    """small takes minutes on two cores, full wants a GPU."""
    parts: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME...")] = ()
    """Which parts of the evaluation; all if not given."""
    asset: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Trained asset, a .ply file, in place of the one that v3dg makes itself."""
    layout: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Published layout (.json) of the instances of that asset and of cameras."""
    peers: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """What other tools made of that asset (v3dg/bench/parts/merging.py says how)."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to build and draw; auto is a CUDA device where there is one and torch can use it."""
    seed: int = 0
    """Seed of assets, layouts and builds."""
    threads: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """CPU threads; all if not given."""
    json: bool = False
    """Print the results as JSON."""
    quiet: bool = False
    """Show no progress."""


@dataclass
class World:
    """Make a world: its assets, their bundles, and a scene file with 400 cameras."""

    name: tyro.conf.Positional[Literal["donut_sea", "forest", "temples", "crowd"]]
    """Which of the V3DG paper's four."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FOLDER")] = None
    """Folder to write to, made if it is not there; the world's name if not given."""
    scale: Literal["small", "full"] = "small"
    """How large: full is about 100 million gaussians, and hours of a CPU or minutes of a GPU."""
    seed: int = 0
    """Seed of the assets, of the layout and of the builds."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to build; auto is a CUDA device where there is one and torch can use it."""
    threads: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """CPU threads; all if not given."""
    json: bool = False
    """Print the result as JSON."""
    quiet: bool = False
    """Show no progress."""


Command: TypeAlias = Build | Info | Render | Demo | Bench | World
_COMMANDS: Any = (
    Annotated[Build, tyro.conf.subcommand("build")]
    | Annotated[Info, tyro.conf.subcommand("info")]
    | Annotated[Render, tyro.conf.subcommand("render")]
    | Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
    | Annotated[World, tyro.conf.subcommand("world")]
)


class _UsageError(Exception):
    """Arguments that cannot be meant; exit code 2."""


def _parse(arguments: Sequence[str]) -> Command:
    """Parse the command line; tyro's boxed message becomes one line."""
    caught = io.StringIO()
    try:
        with contextlib.redirect_stderr(caught):
            parsed = tyro.cli(
                _COMMANDS,
                prog="v3dg",
                description="Level of detail for 3D Gaussian Splatting. `v3dg --version` prints the version.",
                args=arguments,
                config=(tyro.conf.FlagCreatePairsOff,),
            )
    except SystemExit as stop:
        if not stop.code:
            raise
        raise _UsageError(_one_line(caught.getvalue())) from None
    return cast(Command, parsed)


def _one_line(boxed: str) -> str:
    """The text of the first box that tyro drew, without its rules and its title."""
    lines = [line.strip("│╭╮╰╯─ ").strip() for line in boxed.splitlines()[1:]]
    rule = next((i for i, line in enumerate(lines) if not line), len(lines))
    rest = " ".join(line for line in lines[rule:] if line).replace("run:", "run")
    help_at = rest.find("run v3dg")
    hint = rest[help_at:].split("--help")[0] if help_at >= 0 else "run v3dg "
    return " ".join(lines[:rule]).rstrip(".") + f"; {hint}--help"


def _load(path: Path) -> Gaussians | Bundle:
    from v3dg.bundle import Bundle
    from v3dg.io import load

    return Bundle.open(path) if path.suffix == ".v3dg" else load(path)


def _require(path: Path, *suffixes: str) -> None:
    if path.suffix not in suffixes:
        raise ValueError(f"{path}: expected a file ending in {', '.join(suffixes)}")
    if not path.exists():
        raise ValueError(f"{path}: expected a file, got nothing there; check the path")


def _set_threads(threads: int | None) -> None:
    """Start this process anew with that many threads: OpenMP reads the number once, when it is loaded."""
    if threads is None:
        return
    if threads < 1:
        raise _UsageError(f"--threads: expected at least 1, got {threads}")
    if os.environ.get("OMP_NUM_THREADS") != str(threads):
        os.environ["OMP_NUM_THREADS"] = str(threads)
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


def _build(options: Build) -> None:
    _require(options.asset, ".ply")
    from dataclasses import replace

    from v3dg import _device
    from v3dg.build import BuildConfig, build_bundle, discard_levels
    from v3dg.cleaning import AssetWarning, describe
    from v3dg.io import load

    output = options.output or options.asset.with_suffix(".v3dg")
    if output.suffix != ".v3dg":
        raise ValueError(f"{output}: expected a file name ending in .v3dg")
    if not output.parent.is_dir():
        raise ValueError(f"{output}: expected an existing folder, got {output.parent}; create it first")
    config = BuildConfig.paper() if options.config == "paper" else BuildConfig()
    if options.cluster_size is not None:
        config = replace(config, cluster_size=options.cluster_size)
    partial = output.with_name(output.name + ".partial")
    if not options.resume:
        discard_levels(partial)
    device = _device.resolve(options.device)
    start = time.perf_counter()
    asset = load(options.asset)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", AssetWarning)  # the result says it
            bundle = build_bundle(
                asset,
                config=config,
                seed=options.seed,
                progress=not options.quiet,
                device=device,
                resume_path=partial,
                unusable="refuse" if options.strict else "drop",
            )
        bundle.save(output)
    except ValueError as error:
        place = f"{options.asset}: " if str(error).startswith("asset: ") else ""
        raise ValueError(f"{place}{error}") from None
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"interrupted{_to_resume(partial)}") from None
    except OSError as error:  # a full disk, say
        raise OSError(error.errno, f"{error.strerror}{_to_resume(partial)}", error.filename) from None
    partial.unlink(missing_ok=True)
    dropped = bundle.config["dropped"]
    result = {
        "output": str(output),
        "asset_gaussians": len(asset),
        "dropped": dropped,
        "gaussians": bundle.num_gaussians,
        "clusters": len(bundle.clusters),
        "levels": bundle.num_levels,
        "bytes": output.stat().st_size,
        "seconds": time.perf_counter() - start,
    }
    text = (
        f"{output}: {bundle.num_levels} levels, {len(bundle.clusters):,} clusters, "
        f"{bundle.num_gaussians:,} gaussians ({len(asset):,} in the asset), "
        f"{_bytes_text(output.stat().st_size)}, {result['seconds']:.1f} s"
    )
    if dropped:
        text += "\nleft out: " + describe(dropped)
    _print(options.json, result, lambda: text)


def _to_resume(partial: Path) -> str:
    return f"; `--resume` continues from {partial}" if partial.exists() else ""


def _info(options: Info) -> None:
    _require(options.file, ".ply", ".v3dg", ".json")
    if options.file.suffix == ".json":
        from v3dg.scene_file import read_scene

        result, text = _scene_info(options.file, *read_scene(options.file))
    else:
        loaded = _load(options.file)
        describe = _bundle_info if options.file.suffix == ".v3dg" else _asset_info
        result, text = describe(options.file, cast(Any, loaded))
    _print(options.json, result, lambda: text)


def _asset_info(path: Path, asset: Gaussians) -> tuple[dict[str, Any], str]:
    import numpy as np

    from v3dg.cleaning import OUTLIER_DISTANCE, describe, examine, outliers

    findings = examine(asset)
    drawable = asset.subset(findings.drawable)
    far = outliers(drawable.means)
    boxes = {"box": _box(drawable.means), "box_without_outliers": _box(drawable.means[~far])}
    spread = {}
    if len(drawable):
        spread = {
            name: [float(q) for q in np.percentile(values, (5, 50, 95))]
            for name, values in (
                ("longest_scale", drawable.scales.max(axis=1)),
                ("opacity", drawable.opacities),
            )
        }
    result = {
        "path": str(path),
        "kind": "asset",
        "gaussians": len(asset),
        "drawable": len(drawable),
        "not_drawable": findings.counts,
        "outliers": int(far.sum()),
        "sh_degree": asset.sh_degree,
        "bytes": path.stat().st_size,
        **boxes,
        "percentiles_5_50_95": spread,
    }
    lines = [
        f"{path}: asset, {_bytes_text(path.stat().st_size)}",
        f"{len(asset):,} gaussians, SH degree {asset.sh_degree}",
    ]
    if findings.counts:
        lines.append(f"{findings.num_dropped:,} cannot be drawn: {describe(findings.counts)}")
    if len(drawable):
        lines.append("means from {} to {}".format(*map(_point, boxes["box"])))
    if far.any():
        lines.append("without outliers from {} to {}".format(*map(_point, boxes["box_without_outliers"])))
        lines.append(
            f"{far.sum():,} outliers, {OUTLIER_DISTANCE:g} median distances from the median or farther"
        )
    for name, (p5, p50, p95) in spread.items():
        name = name.replace("_", " ")
        lines.append(f"{name}: 5 % below {p5:.3g}, half below {p50:.3g}, 95 % below {p95:.3g}")
    return result, "\n".join(lines)


def _box(means: Any) -> list[list[float]]:
    """Lower and upper corner of positions; nothing for none."""
    return [means.min(axis=0).tolist(), means.max(axis=0).tolist()] if len(means) else []


def _point(values: Sequence[float]) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in values) + ")"


def _bundle_info(path: Path, bundle: Bundle) -> tuple[dict[str, Any], str]:
    result = {**bundle.info(), "path": str(path), "kind": "bundle"}
    rows = [
        (
            str(level["level"]),
            f"{level['clusters']:,}",
            f"{level['gaussians']:,}",
            _bytes_text(level["bytes"]),
            _number(level["error_color"]),
            _number(level["error_alpha"]),
        )
        for level in result["levels"]
    ]
    lines = [
        f"{path}: bundle, version {result['version']}, {_bytes_text(result['bytes'])}",
        f"{bundle.num_gaussians:,} gaussians, SH degree {bundle.sh_degree}, "
        f"{len(bundle.clusters):,} clusters, {len(bundle.groups):,} groups, {result['num_pages']:,} pages",
        "",
        *_table(("level", "clusters", "gaussians", "size", "colour error", "alpha error"), rows),
    ]
    if result["config"]:
        settings = ", ".join(f"{name}={value}" for name, value in _settings(result["config"]))
        lines += ["", *textwrap.wrap(f"built with {settings}", 100, break_on_hyphens=False)]
    return result, "\n".join(lines)


def _scene_info(path: Path, scene: Scene, cameras: dict[str, Camera]) -> tuple[dict[str, Any], str]:
    counts = [int((scene.instance_bundle == b).sum()) for b in range(len(scene.bundles))]
    full = [int(len(bundle.level_range(0)) and _level_size(bundle, 0)) for bundle in scene.bundles]
    total = sum(n * m for n, m in zip(counts, full, strict=True))
    result = {
        "path": str(path),
        "kind": "scene",
        "instances": len(scene),
        "gaussians_at_full_detail": total,
        "bundles": [
            {"path": bundle.path, "instances": n, "asset_gaussians": m}
            for bundle, n, m in zip(scene.bundles, counts, full, strict=True)
        ],
        "cameras": [
            {"name": name, "width": camera.width, "height": camera.height} for name, camera in cameras.items()
        ],
    }
    lines = [
        f"{path}: scene, {len(scene):,} instances, {total:,} gaussians at full detail",
        "",
        *_table(
            ("bundle", "instances", "asset gaussians"),
            [
                (str(b.path or "-"), f"{n:,}", f"{m:,}")
                for b, n, m in zip(scene.bundles, counts, full, strict=True)
            ],
        ),
    ]
    if cameras:
        rows = [(name, f"{camera.width} x {camera.height}") for name, camera in cameras.items()]
        lines += ["", *_table(("camera", "size"), rows)]
    return result, "\n".join(lines)


def _level_size(bundle: Bundle, level: int) -> int:
    clusters = bundle.level_range(level)
    return int(bundle.clusters.offset[clusters.stop] - bundle.clusters.offset[clusters.start])


def _render(options: Render) -> None:
    _require(options.subject, ".ply", ".v3dg", ".json")
    from v3dg import _device
    from v3dg.pictures import check_picture_path, write_picture
    from v3dg.render import render

    if min(options.views, *options.size) < 1:
        raise _UsageError("--views, --size: expected at least 1")
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
    _print(
        options.json,
        {"subject": str(options.subject), "pictures": results},
        lambda: "\n".join(_table(header, rows)),
    )


def _subject_and_cameras(options: Render) -> tuple[Scene | Bundle | Gaussians, dict[str, Camera]]:
    """What to draw, and from where: the file of --cameras, else a scene's own cameras, else a turntable."""
    is_scene = options.subject.suffix == ".json"
    if options.cameras is None and not is_scene:
        if options.camera is not None:
            raise _UsageError("--camera: expected --cameras or a scene (.json) to take it from; leave it out")
        loaded = _load(options.subject)
        return loaded, _turntable(loaded, options)
    subject: Scene | Bundle | Gaussians
    cameras: dict[str, Camera] = {}
    if is_scene:
        from v3dg.scene_file import read_scene

        subject, cameras = read_scene(options.subject)
    else:
        subject = _load(options.subject)
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
        sizes = [_level_size(subject, level) for level in range(subject.num_levels)]
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


def _demo(options: Demo) -> None:
    from v3dg.demo import run_demo, table_text
    from v3dg.select import DEFAULT_TOLERANCE

    result = run_demo(
        options.output,
        num_gaussians=options.gaussians,
        instances=options.instances,
        size=options.size,
        tolerance=DEFAULT_TOLERANCE if options.tolerance is None else options.tolerance,
        seed=options.seed,
        progress=not options.quiet,
    )
    _print(
        options.json,
        result.as_dict(),
        lambda: f"{table_text(result)}\n\nwrote {result.picture} in {result.seconds:.0f} s",
    )


def _bench(options: Bench) -> None:
    for path, suffix in ((options.asset, ".ply"), (options.layout, ".json")):
        if path is not None:
            _require(path, suffix)
    if options.layout is not None and options.asset is None:
        raise _UsageError("--layout: expected --asset with it, the asset that it places")
    from v3dg import _device, bench

    stage = bench.Stage(
        bench.PRESETS[options.preset],
        _device.resolve(options.device),
        options.output,
        seed=options.seed,
        asset_path=options.asset,
        layout_path=options.layout,
        peers=options.peers,
    )
    results = bench.run(stage, options.preset, options.parts or bench.NAMES, quiet=options.quiet)

    def text() -> str:
        sections = [
            f"## {bench.part(name).TITLE}\n\n{bench.part(name).tables(r)}" for name, r in results.items()
        ]
        return "\n\n".join([*sections, f"Plots and a page: python -m v3dg.bench.report {options.output}"])

    _print(options.json, results, text)


def _world(options: World) -> None:
    from v3dg import _device, worlds

    start = time.perf_counter()
    arguments = worlds.SMALL[options.name] if options.scale == "small" else {}
    world = worlds.WORLDS[options.name](**arguments, seed=options.seed)
    path = worlds.write_world(
        world,
        options.output or Path(options.name),
        seed=options.seed,
        device=_device.resolve(options.device),
        progress=not options.quiet,
    )
    result = {
        "output": str(path),
        "assets": list(world.assets),
        "instances": world.num_instances,
        "gaussians": world.num_gaussians,
        "extent": world.extent,
        "seconds": time.perf_counter() - start,
    }
    text = (
        f"{path}: {world.num_instances:,} instances of {len(world.assets)} assets, "
        f"{world.num_gaussians:,} gaussians, {result['seconds']:.0f} s\n"
        f"draw it with `v3dg render {path} --camera 059_camera_19`"
    )
    _print(options.json, result, lambda: text)


def _print(as_json: bool, result: dict[str, Any], text: Callable[[], str]) -> None:
    print(json.dumps(result, indent=1) if as_json else text())


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table: the first column to the left, the others to the right."""
    widths = [max(len(row[i]) for row in (header, *rows)) for i in range(len(header))]
    return [
        "  ".join(
            cell.rjust(w) if i else cell.ljust(w) for i, (cell, w) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in (header, *rows)
    ]


def _bytes_text(count: int) -> str:
    for factor, unit in ((1 << 30, "GiB"), (1 << 20, "MiB"), (1 << 10, "KiB")):
        if count >= factor:
            return f"{count / factor:.1f} {unit}"
    return f"{count} B"


def _number(value: float | None) -> str:
    return "-" if value is None or value != value else f"{value:.4f}"


def _settings(config: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Names and values of a bundle's config, without its nesting."""
    for name, value in config.items():
        if isinstance(value, dict):
            yield from _settings(value)
        else:
            yield name, value if isinstance(value, str) else json.dumps(value)


def _safe(name: str) -> str:
    """A camera's name as part of a file name."""
    return "".join(c if c.isalnum() or c in "-_." else "_" for c in name)


_RUN: dict[type[Any], Callable[[Any], None]] = {
    Build: _build,
    Info: _info,
    Render: _render,
    Demo: _demo,
    Bench: _bench,
    World: _world,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command, by default the one this program was started with, and return its exit code."""
    is_program = arguments is None
    arguments = sys.argv[1:] if arguments is None else arguments
    if list(arguments) == ["--version"]:
        print(f"v3dg {__version__}")
        return 0
    try:
        options = _parse(arguments)
        if is_program:
            _set_threads(getattr(options, "threads", None))
        _RUN[type(options)](options)
        sys.stdout.flush()
    except _UsageError as error:
        return _fail(str(error), 2)
    except KeyboardInterrupt as stop:
        return _fail(str(stop) or "interrupted", 130)
    except BrokenPipeError:  # the reader of our output has gone: nobody is left to tell
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        return _fail(f"{error.filename}: {error.strerror}" if error.filename else str(error), 1)
    except MemoryError as error:
        numbers = f" ({error})" if str(error) else ""
        return _fail(f"not enough memory{numbers}; use smaller pictures or a smaller asset", 1)
    except (ValueError, RuntimeError, ImportError) as error:
        return _fail(str(error), 1)
    return 0


def _fail(message: str, code: int) -> int:
    print("v3dg: error: " + " ".join(message.split()), file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
