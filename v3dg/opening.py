"""Opens the files of scenes, bundles and assets."""

import os
from pathlib import Path
from typing import Any, TypeAlias

from v3dg._numbers import check
from v3dg._urls import beside, is_url, reading, shown
from v3dg.bundle import Bundle
from v3dg.cameras import Camera
from v3dg.formats import usd
from v3dg.io import read_asset
from v3dg.levels import BuildConfig, build_bundle
from v3dg.scene import Scene, Subject
from v3dg.scene.file import is_scene, read_scene

File: TypeAlias = str | os.PathLike[str]
"""A path that functions accept in place of a subject. They open it with `open`."""


def open(path: str | os.PathLike[str]) -> Subject:
    """Open a file: a scene (.json), a bundle (.v3dg), or an asset in any format of
    `read_asset`. The end of the name determines which one it is.

    `read_scene` also returns the cameras of a scene. An OpenUSD file with instances is
    opened as a scene, see `read_usd_scene`.

    Raises:
        ValueError: The content does not match the name of the file, or the name is
            unknown.
        OSError: The file cannot be read.
    """
    return open_with_cameras(Path(path))[0]


def opened(subject: object) -> Any:
    """Return the subject in a file. Anything but a file name is returned unchanged."""
    if isinstance(subject, str | os.PathLike):
        return open(subject)
    return subject


def open_with_cameras(path: Path) -> tuple[Subject, dict[str, Camera] | None]:
    """Open a file. Return a scene and its cameras; for a bundle or an asset, return
    None instead of cameras."""
    if is_scene(path):
        expected = (
            "a scene on this machine, got a URL; download it together with the files that it "
            "refers to"
        )
        check(shown(path), not is_url(path), expected)
        return read_scene(path)
    if beside(path).suffix == ".v3dg":
        return Bundle.open(path), None
    if beside(path).suffix.lower() not in usd.SUFFIXES:
        return read_asset(path), None
    with reading(path) as local:
        if usd.has_instances(local):
            return read_usd_scene(local), None
        return read_asset(local), None


def read_usd_scene(
    path: str | os.PathLike[str], *, config: BuildConfig | None = None, device: str = "auto"
) -> Scene:
    """Read an OpenUSD file as a scene. A bundle is built from each asset in the file,
    and placed at the poses of its instances.

    Instances are those of PointInstancers, which may be nested, and prims that refer to
    the same gaussians. Any other prim of gaussians is a single instance. Only the
    finest level of detail is read. Needs the extra `usd`.

    Args:
        config: Settings of the builds. With None, levels are built without fitting
            them, which takes seconds.
        device: The device that builds, see `build_bundle`.

    Raises:
        ImportError: usd-core is not installed.
        ValueError: The file is not OpenUSD with gaussians, or a transform is not a
            rotation, a translation and a uniform scale.
        OSError: The file cannot be read.
    """
    with reading(path) as local:
        assets, asset_from_instance, poses, up = usd.read_world(local)
    config = config or BuildConfig(steps=0)
    bundles = [
        build_bundle(asset, config=config, device=device, progress=False) for asset in assets
    ]
    scene = Scene()
    quaternions, positions, scales = zip(*poses, strict=True)
    bundle_from_instance = [bundles[asset] for asset in asset_from_instance]
    scene.add(bundle_from_instance, positions, quaternions, scales)
    scene.up = up
    return scene
