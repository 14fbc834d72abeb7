"""Level of detail for 3D Gaussian Splatting: build bundles of clusters, select a cut, draw it."""

from v3dg._version import __version__
from v3dg.cameras import Camera, turntable
from v3dg.gaussians import Gaussians
from v3dg.io import load, save

__all__ = ["Camera", "Gaussians", "__version__", "load", "save", "turntable"]
