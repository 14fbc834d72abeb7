"""Level of detail for 3D Gaussian Splatting: build bundles of clusters, select a cut, draw it."""

from importlib.util import find_spec as _find_spec

if _find_spec("v3dg._core") is None:
    raise ImportError(
        f"v3dg: the compiled module is missing in {__path__[0]}; if this is the source folder, start Python "
        "elsewhere (after `pip install .`) or install with `pip install -e .`"
    )

from v3dg._version import __version__
from v3dg.bundle import Bundle, Clusters, Groups
from v3dg.cameras import Camera, turntable
from v3dg.gaussians import Gaussians
from v3dg.io import load, save
from v3dg.rasterize import Raster, rasterize
from v3dg.scene import Scene, read_scene, write_scene
from v3dg.select import Selection, select

__all__ = [
    "Bundle",
    "Camera",
    "Clusters",
    "Gaussians",
    "Groups",
    "Raster",
    "Scene",
    "Selection",
    "__version__",
    "load",
    "rasterize",
    "read_scene",
    "save",
    "select",
    "turntable",
    "write_scene",
]
