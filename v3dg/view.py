"""Starts the viewer from Python."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

from v3dg._device import Device
from v3dg._numbers import one_of
from v3dg._urls import is_url
from v3dg.cameras import AXES, Axis, Camera, VectorLike
from v3dg.io import subject_name
from v3dg.opening import File, open_with_cameras
from v3dg.scene import Subject
from v3dg.upright import ASSUMED, direction_of, up_of

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from v3dg.viewer.server import Site


class _SiteOptions(TypedDict, total=False):
    """Options of `v3dg.viewer.server.Site`."""

    name: str
    cameras: Mapping[str, Camera] | None
    photographs: Mapping[str, Path] | None
    host: str
    port: int
    tolerance: float
    budget: int | None
    background: Sequence[float]
    asks_up: bool
    edits_folder: Path | None


def view(
    subject: Subject | File,
    *,
    device: str | Device = "auto",
    memory: int | str | None = "auto",
    up: Axis | VectorLike | None = None,
    **options: Unpack[_SiteOptions],
) -> Site:
    """Show a scene, a bundle, an asset, or a file with one of them, in a web browser
    (docs/viewer.md).

    The viewer's server runs on threads of this process. Its address is printed, and is
    also the `url` of the returned site. Call `close()` of the site to end the server.

    Args:
        device: See `v3dg.render`.
        memory: See `v3dg.Renderer`.
        up: The axis or direction that points up at first; None uses the axis of
            `v3dg.upright.up_of`.
        options: Options of `v3dg.viewer.server.Site`, such as `cameras` by name,
            `port`, `tolerance`, `budget` and `background`. Without `cameras`, those in
            the file of a scene are used.

    Raises:
        ImportError: The extra `viewer` is not installed.
    """
    from v3dg.viewer.frame import SceneView
    from v3dg.viewer.server import Site

    if isinstance(subject, str | os.PathLike):
        path = Path(subject)
        subject, cameras = open_with_cameras(path)
        options.setdefault("name", subject_name(path))
        options.setdefault("cameras", cameras)
        if not is_url(path):
            options.setdefault("edits_folder", path.absolute().parent)
    if up is None:
        up, reason = up_of(subject, options.get("cameras"))
        options.setdefault("asks_up", reason == ASSUMED)
    if isinstance(up, str):
        one_of(up, "up", AXES)
        up = direction_of(up)
    site = Site(SceneView(subject, device=device, memory=memory), up=up, **options)
    print(f"{site.url} shows the subject until close() is called")
    return site
