"""Exports a scene as a web page that draws it with WebGPU: quantised bundles, the scene
file, and the viewer's modules. The page needs only a static web server."""

import copy
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np

from v3dg import _files
from v3dg._numbers import check
from v3dg._progress import Bar, Progress
from v3dg._urls import is_url
from v3dg.bundle import Bundle
from v3dg.bundle.codec import Quantized
from v3dg.cameras import Axis, Camera
from v3dg.export import _common
from v3dg.export._folder import replacing_export
from v3dg.framing import frame_subject
from v3dg.opening import File
from v3dg.scene import Scene
from v3dg.scene.file import write_scene
from v3dg.upright import direction_of, up_of

SCENE = "scene.json"
_WEB = Path(__file__).parent / "web"
_CORE = "core.wasm"
# The viewer of `v3dg view` moves its camera with these modules, too.
_CAMERA_MODULES = Path(__file__).parents[1] / "viewer" / "page"
_CAMERA_NAMES = ("camera.js", "math.js")
_START_WIDTH = 1600
_START_HEIGHT = 900


@dataclass(frozen=True)
class WebPage:
    """A finished export.

    Attributes:
        bundles: Number of distinct bundles.
        instances: Number of instances.
        gaussians: Number of gaussians in the finest level of all instances together.
        bytes: Total size of the written files.
    """

    bundles: int
    instances: int
    gaussians: int
    bytes: int


def write_web_page(
    subject: Scene | Bundle | File,
    folder: str | os.PathLike[str],
    cameras: Mapping[str, Camera] | None = None,
    *,
    up: Axis | None = None,
    progress: Progress = False,
    overwrite: bool = False,
) -> WebPage:
    """Write a scene or a bundle as a web page that draws it with levels of detail. The
    files of an earlier export are replaced when all new files are complete.

    The page selects cuts as `v3dg.select` does, with WebAssembly, and draws them with
    WebGPU. It reads the pages of bundles that it needs from the server, by HTTP ranges.
    Bundles are written with the codec "quantized". Lens distortion of cameras is left
    out.

    Args:
        subject: A scene or a bundle, or the path of its file. The file of a scene may
            also contain cameras.
        folder: See `write_site`.
        cameras: Cameras that the page offers, by name. The page starts with the first
            one; without cameras, with a view of the whole scene.
        up: The axis that points up in the world; None uses the axis of
            `v3dg.upright.up_of`.
        progress: See `v3dg.build_bundle`.
        overwrite: See `write_streamed_sog`.

    Raises:
        TypeError: `cameras` is not a mapping from names to cameras.
        ValueError: The scene has no instances; or see `write_streamed_sog`.
        RuntimeError: The package was installed without the core for web pages, or
            another export is using the folder.
        OSError: A file cannot be written.
    """
    _check_core()
    content, cameras = _common.opened_with_cameras(subject, Path(folder), cameras)
    scene = copy.copy(Scene.of(content))
    check("scene", len(scene), "at least one instance to export, got none; add an instance")
    axis = up or up_of(content, cameras)[0]
    scene.up = axis
    if not cameras:
        framing = frame_subject(scene)
        cameras = {"start": framing.camera(direction_of(axis), _START_WIDTH, _START_HEIGHT)}
    names = [f"{name}.v3dg" for name in _common.names_of(scene)]
    with replacing_export(Path(folder), scene, [SCENE, "index.html"], overwrite=overwrite) as new:
        with Bar(len(names), "export", progress) as bar:
            for name, bundle in zip(names, scene.bundles, strict=True):
                _write_bundle(bundle, new.path / name)
                bar.update(1)
        write_scene(new.path / SCENE, scene, names, cameras)
        _write_viewer(new.path)
        num_bytes = _common.bytes_below(new.path)
    finest = [bundle.num_leaves for bundle in scene.bundles]
    gaussians = int(np.array(finest, np.int64)[scene.instance_bundle].sum())
    return WebPage(len(names), len(scene), gaussians, num_bytes)


def _check_core() -> None:
    if (_WEB / _CORE).is_file():
        return
    raise RuntimeError(
        "web page: this installation has no core for web pages, because zig was missing when it "
        "was built; install a wheel of a release, run pip install ziglang and build v3dg again, "
        "or export for another engine (--to sog)"
    )


def _write_bundle(bundle: Bundle, path: Path) -> None:
    """Write a bundle with the codec that the page reads."""
    is_file = bundle.path is not None and not is_url(bundle.path)
    if is_file and bundle.codec == Quantized.name:
        source = Path(cast(str, bundle.path))
        with _files.naming_errors(source):
            shutil.copyfile(source, path)
        return
    Bundle(bundle.clusters, bundle.groups, bundle.gaussians, bundle.config, Quantized.name).write(
        path
    )


def _write_viewer(folder: Path) -> None:
    """Write the page and its modules."""
    shutil.copyfile(_WEB / "page.html", folder / "index.html")
    modules = folder / "viewer"
    modules.mkdir()
    for source in sorted(_WEB.iterdir()):
        if (
            source.suffix in {".js", ".css", ".wgsl", ".wasm", ".ts"}
            or source.name == "package.json"
        ):
            shutil.copyfile(source, modules / source.name)
    for name in _CAMERA_NAMES:
        shutil.copyfile(_CAMERA_MODULES / name, modules / name)
