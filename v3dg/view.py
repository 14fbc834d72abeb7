"""The viewer, started from Python."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from v3dg._device import Device
from v3dg.opening import open_with_cameras
from v3dg.scene import Subject

if TYPE_CHECKING:
    from v3dg.viewer.server import Site


def view(
    subject: Subject | str | os.PathLike[str],
    *,
    device: str | Device = "auto",
    memory: int | str | None = "auto",
    **options: Any,
) -> Site:
    """Show a scene, a bundle or an asset, or the file of one, in a web browser (docs/viewer.md).

    The viewer's server runs on threads of this process. Its address is printed, and is the `url` of what is
    returned; `close()` of that ends it.

    Args:
        device: As in `v3dg.render`.
        memory: As in `v3dg.Renderer`.
        options: As `v3dg.viewer.server.Site` takes them, such as `cameras`, by name, `port`, `tolerance`,
            `budget` and `up`. A scene's file brings its own cameras.

    Raises:
        ImportError: The extra `viewer` is not installed.
    """
    from v3dg.viewer.frame import SceneView
    from v3dg.viewer.server import Site

    if isinstance(subject, str | os.PathLike):
        path = Path(subject)
        subject, cameras = open_with_cameras(path)
        options = {"name": path.stem, "cameras": cameras} | options
    site = Site(SceneView(subject, device=device, memory=memory), **options)
    print(f"{site.url} shows it until close() is called")
    return site
