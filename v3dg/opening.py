"""Files by their names: scenes, bundles and assets."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TypeAlias

from v3dg.bundle import Bundle
from v3dg.cameras import Camera
from v3dg.gaussians import Gaussians
from v3dg.io import SUFFIXES, read_asset
from v3dg.scene import Scene
from v3dg.scene.file import read_scene

Subject: TypeAlias = Scene | Bundle | Gaussians


def open(path: str | os.PathLike[str]) -> Subject:
    """Open a file by its name: a scene (.json), a bundle (.v3dg) or an asset, as `read_asset` does.

    `read_scene` gives the cameras of a scene, too.

    Raises:
        ValueError: The file is not what its name says, or has another name.
        OSError: It cannot be read.
    """
    return open_with_cameras(Path(path))[0]


def open_with_cameras(path: Path) -> tuple[Subject, dict[str, Camera] | None]:
    """A scene with its cameras, or a bundle or an asset, which have none."""
    if is_scene(path):
        return read_scene(path)
    return Bundle.open(path) if path.suffix == ".v3dg" else read_asset(path), None


def is_scene(path: Path) -> bool:
    """Whether a file is a scene by its name: JSON, but not the `meta.json` of an asset in SOG."""
    return path.suffix == ".json" and not path.name.endswith(SUFFIXES)
