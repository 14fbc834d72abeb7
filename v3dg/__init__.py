"""Level of detail for 3D Gaussian Splatting: build bundles of clusters, select a cut,
draw it."""

from v3dg import _start as _start  # imported first, so that commands handle Ctrl-C

# isort: split
from importlib.util import find_spec as _find_spec

if _find_spec("v3dg._core") is None:
    raise ImportError(
        f"v3dg: the compiled module is missing in {__path__[0]}; if this is the source folder, "
        "start Python elsewhere (after `pip install .`) or install with `pip install -e .`"
    )

from v3dg._version import __version__
from v3dg.bundle import Bundle, Clusters, Groups
from v3dg.camera_batch import CameraBatch
from v3dg.camera_file import read_cameras, write_cameras
from v3dg.cameras import Camera, StereoCamera, turntable
from v3dg.editing import (
    crop_box,
    crop_sphere,
    drop_outliers,
    drop_transparent,
    join,
    to_degree,
)
from v3dg.export import write_site, write_streamed_sog, write_tiles, write_usd, write_web_page
from v3dg.gaussians import Gaussians
from v3dg.image import Image, RenderedImage, Stats
from v3dg.io import read_asset, write_asset
from v3dg.levels import BuildConfig, build_bundle
from v3dg.opening import open as open  # not in __all__: `import *` would hide Python's own `open`
from v3dg.opening import read_usd_scene
from v3dg.panorama import draw_panorama
from v3dg.pick import Pick, pick
from v3dg.rasterize import rasterize
from v3dg.refine import refine_bundle
from v3dg.render import (
    MESH,
    BatchPlanes,
    MeshLayer,
    RenderedBatch,
    Renderer,
    first_camera,
    render,
)
from v3dg.scan import Scan, ScanBatch, scan
from v3dg.scene import Scene
from v3dg.scene.file import read_scene, write_scene
from v3dg.select import DEFAULT_FADE, DEFAULT_TOLERANCE, Selection, select
from v3dg.spherical import EquirectangularCamera, Lidar
from v3dg.view import view

__all__ = ["BuildConfig", "Bundle", "Clusters", "Gaussians", "Groups"]
__all__ += ["__version__", "build_bundle", "read_asset", "refine_bundle", "write_asset"]
__all__ += ["crop_box", "crop_sphere", "drop_outliers", "drop_transparent", "join", "to_degree"]
__all__ += [
    "Camera",
    "Scene",
    "read_cameras",
    "read_scene",
    "turntable",
    "write_cameras",
    "write_scene",
]
__all__ += [
    "DEFAULT_FADE",
    "DEFAULT_TOLERANCE",
    "Image",
    "Pick",
    "RenderedImage",
    "Renderer",
    "Stats",
]
__all__ += ["MESH", "BatchPlanes", "CameraBatch", "MeshLayer", "RenderedBatch"]
__all__ += ["draw_panorama", "first_camera"]
__all__ += ["EquirectangularCamera", "Lidar", "Scan", "ScanBatch", "scan"]
__all__ += ["Selection", "StereoCamera", "pick", "rasterize", "render", "select", "view"]
__all__ += ["read_usd_scene", "write_site", "write_streamed_sog", "write_tiles", "write_usd"]
__all__ += ["write_web_page"]
