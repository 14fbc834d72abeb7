"""Level of detail for 3D Gaussian Splatting: build bundles of clusters, select a cut, draw it."""

from v3dg._version import __version__
from v3dg.cameras import Camera, turntable

__all__ = ["Camera", "__version__", "turntable"]
