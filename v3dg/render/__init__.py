"""Draw scenes, bundles and assets: select a cut, then project, bin and blend it.

`api.py` has `v3dg.render`, and `renderer.py` has `v3dg.Renderer`. Both draw with a
frame: of an asset (`asset_frame.py`), of a scene whose gaussians are all resident
(`scene_frame.py`), or of a pool (`pool_frame.py`). `frame.py` defines the interface of
frames and chooses one. `request.py` defines the requests.
"""

from v3dg.render.api import first_camera, render
from v3dg.render.batch import BatchPlanes, RenderedBatch
from v3dg.render.frame import Frame, FrameSource, frame_of
from v3dg.render.pool_frame import PoolFrame
from v3dg.render.renderer import Renderer
from v3dg.render.request import (
    CutRequest,
    FrameRequest,
    Look,
    shade_of,
)
from v3dg.render.sensor import CHANNELS, MESH, Channel, MeshLayer

__all__ = [
    "CHANNELS",
    "MESH",
    "BatchPlanes",
    "Channel",
    "CutRequest",
    "Frame",
    "FrameRequest",
    "FrameSource",
    "Look",
    "MeshLayer",
    "PoolFrame",
    "RenderedBatch",
    "Renderer",
    "first_camera",
    "frame_of",
    "render",
    "shade_of",
]
