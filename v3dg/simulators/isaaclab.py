"""Isaac Lab: a renderer for its cameras that draws gaussians.

    from v3dg.simulators.isaaclab import SplatRendererCfg

    camera = CameraCfg(..., renderer_cfg=SplatRendererCfg(path="room.v3dg"))

It implements the interface `isaaclab.renderers.BaseRenderer` of Isaac Lab 3.0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from v3dg import _device, opening
from v3dg._numbers import Floats, check, refuse
from v3dg.camera_batch import CameraBatch
from v3dg.gaussians import Gaussians
from v3dg.render import RenderedBatch, Renderer
from v3dg.scene import Scene
from v3dg.simulators._colors import rgba_of
from v3dg.simulators._poses import rotations_of, write_viewmats

try:
    import warp
    from isaaclab.renderers import (
        BaseRenderer,
        CameraRenderSpec,
        RenderBufferKind,
        RenderBufferSpec,
        RendererCfg,
    )
    from isaaclab.utils import configclass
except ImportError as error:
    raise ImportError(
        "Isaac Lab: expected isaaclab>=3.0, got no package or an older version; run "
        "pip install 'isaaclab>=3.0'"
    ) from error

from v3dg.simulators._streams import torch_in_order

if TYPE_CHECKING:
    import torch
    from isaaclab.sensors.camera.camera_data import CameraData
    from isaaclab.utils.warp import ProxyArray
    from pxr import Usd

    from v3dg.render.sensor import Channel

_COLORS = {RenderBufferKind.RGB: 3, RenderBufferKind.RGBA: 4}
_CHANNELS: dict[RenderBufferKind, Channel] = {
    RenderBufferKind.DEPTH: "depth",
    RenderBufferKind.DISTANCE_TO_IMAGE_PLANE: "depth",
    RenderBufferKind.DISTANCE_TO_CAMERA: "depth",
    RenderBufferKind.NORMALS: "normal",
    RenderBufferKind.SEMANTIC_SEGMENTATION: "label",
    RenderBufferKind.INSTANCE_SEGMENTATION: "instance",
}


@configclass
class SplatRendererCfg(RendererCfg):
    """Configuration of `SplatRenderer`."""

    class_type: type[BaseRenderer] | str = "v3dg.simulators.isaaclab:SplatRenderer"
    """Renderer implementation class."""

    renderer_type: str = "v3dg"
    """Type identifier."""

    path: str = ""
    """Bundle (.v3dg) or scene (.json) that is placed in every environment, in the axes
    of the stage. If it is empty, add instances to `SplatRenderer.scene` instead."""

    environment_prims: str = "/World/envs/env_{}"
    """Prims of the environments.

    The content of `path` is placed at their translations.
    """

    depth_background: float = math.inf
    """Depth of pixels without gaussians."""

    tolerance: float | None = None
    """As in `v3dg.Renderer.render_batch`."""

    device: str = "auto"
    """Device that draws. "auto" means the device of the cameras."""

    def supported_output_types(self) -> dict[RenderBufferKind, RenderBufferSpec]:
        """Return the layouts of the supported outputs."""
        specs = {kind: RenderBufferSpec(size, warp.uint8) for kind, size in _COLORS.items()}
        for kind, channel in _CHANNELS.items():
            layouts = {
                "depth": RenderBufferSpec(1, warp.float32),
                "normal": RenderBufferSpec(3, warp.float32),
            }
            specs[kind] = layouts.get(channel, RenderBufferSpec(1, warp.int32))
        return specs


@dataclass(eq=False)
class RenderData:
    """One camera of every environment."""

    viewmats: torch.Tensor  # (N, 4, 4) from world to camera
    K: torch.Tensor  # (N, 3, 3)
    width: int
    height: int
    near: float
    background: tuple[float, float, float]
    outputs: dict[RenderBufferKind, torch.Tensor]


class SplatRenderer(BaseRenderer):
    """Draws gaussians for cameras of Isaac Lab. The picture of environment i shows the
    instances of that environment and the shared ones.

    Outputs are `rgb`, `rgba` (with coverage), `depth`, `distance_to_image_plane`,
    `distance_to_camera`, `normals` (in the world), `semantic_segmentation` (labels of
    the scene, -1 for none) and `instance_segmentation` (ids of instances). Ids are
    int32, not colours. Meshes of the stage are not drawn.

    Call `sim.get_or_create_backend(cfg)` to get the renderer of a simulation. In every
    step, move instances with `renderer.scene.move`, using tensors on the device:
    `asset.data.root_pos_w.torch`, and `root_quat_w` as w x y z.

    Attributes:
        cfg: The configuration.
        scene: The instances. Those of `cfg.path` come first, environment by
            environment.
    """

    def __init__(self, cfg: SplatRendererCfg) -> None:
        self.cfg = cfg
        self.scene = Scene()
        self._renderer: Renderer | None = None

    def supported_output_types(self) -> dict[RenderBufferKind, RenderBufferSpec]:
        """Return the layouts of the supported outputs."""
        return self.cfg.supported_output_types()

    def prepare_stage(self, stage: Usd.Stage | None, num_envs: int) -> None:
        """Add the content of `cfg.path` once for each environment.

        Args:
            stage: A `Usd.Stage`. With None, all environments have the same origin.
            num_envs: Number of environments.

        Raises:
            OSError: The file cannot be read.
            ValueError: The file is not a bundle or a scene, or an environment has no
                prim.
        """
        if not self.cfg.path:
            return
        subject = opening.open(self.cfg.path)
        if isinstance(subject, Gaussians):
            expected = "a bundle or a scene, got an asset; build a bundle with `v3dg build`"
            refuse("path", expected)
        scene = Scene.of(subject)
        for number in range(num_envs):
            path = self.cfg.environment_prims.format(number)
            place = np.zeros(3)
            if stage is not None:
                place = _translation_of(stage, path)
            self.scene.add_scene(scene, place, environment=number)

    def create_render_data(self, spec: CameraRenderSpec) -> RenderData:
        """Return the data of a camera.

        Raises:
            ValueError: The camera has lens distortion.
        """
        import torch

        cfg = spec.cfg
        near = 0.01
        if cfg.spawn is not None:
            has_lens = getattr(cfg.spawn, "distortion", None) is not None
            check("spawn.distortion", not has_lens, "a pinhole camera, got lens distortion")
            near = float(cfg.spawn.clipping_range[0])
        background = (0.0, 0.0, 0.0)
        if cfg.background_color is not None:
            red, green, blue = cfg.background_color
            background = (float(red), float(green), float(blue))
        count = spec.num_instances
        return RenderData(
            viewmats=torch.eye(4, device=spec.device).repeat(count, 1, 1),
            K=torch.eye(3, device=spec.device).repeat(count, 1, 1),
            width=cfg.width,
            height=cfg.height,
            near=near,
            background=background,
            outputs={},
        )

    def set_outputs(self, render_data: RenderData, output_data: dict[str, ProxyArray]) -> None:
        """Store the buffers (N, H, W, C) to which `render` writes."""
        render_data.outputs = {
            RenderBufferKind(name): array.torch for name, array in output_data.items()
        }

    def update_transforms(self) -> None:
        """Do nothing, because the simulation moves instances with `scene.move`."""

    def update_geometries(self) -> None:
        """Do nothing, because gaussians do not change."""

    def update_camera(
        self,
        render_data: RenderData,
        positions: ProxyArray,
        orientations: ProxyArray,
        intrinsics: ProxyArray,
    ) -> None:
        """Set the poses and the intrinsics of the cameras. The axes of a pose are x
        forward, y left and z up."""
        import torch

        with torch_in_order(positions.warp.device):
            columns = rotations_of(orientations.torch).transpose(1, 2)
            axes = torch.stack([-columns[:, 1], -columns[:, 2], columns[:, 0]], dim=1)
            write_viewmats(render_data.viewmats, positions.torch, axes)
            render_data.K.copy_(intrinsics.torch)

    def update_camera_intrinsics(
        self, render_data: RenderData, intrinsics: warp.array, parameters: warp.array
    ) -> None:
        """Set the intrinsics of the cameras. The physical parameters are not used."""
        with torch_in_order(intrinsics.device):
            render_data.K.copy_(warp.to_torch(intrinsics))

    def render(self, render_data: RenderData) -> None:
        """Draw the pictures of all environments into the outputs."""
        cameras = CameraBatch(
            render_data.viewmats,
            render_data.K,
            render_data.width,
            render_data.height,
            render_data.near,
            environments=np.arange(len(render_data.K)),
        )
        used = {_CHANNELS[kind] for kind in render_data.outputs if kind in _CHANNELS}
        with torch_in_order(warp.device_from_torch(render_data.viewmats.device)):
            pictures = self._renderer_on(render_data.viewmats).render_batch(
                cameras,
                background=render_data.background,
                tolerance=self.cfg.tolerance,
                channels=tuple(sorted(used)),
            )
            for kind, target in render_data.outputs.items():
                target.copy_(self._output_of(kind, pictures, render_data))

    def _renderer_on(self, tensor: torch.Tensor) -> Renderer:
        if self._renderer is None:
            name = self.cfg.device
            if name == "auto":
                name = str(tensor.device)
            self._renderer = Renderer(self.scene, device=_device.resolve(name), memory=None)
        return self._renderer

    def _output_of(
        self, kind: RenderBufferKind, pictures: RenderedBatch, data: RenderData
    ) -> torch.Tensor:
        """Return an output (N, H, W, C) from the pictures."""
        import torch

        if kind in _COLORS:
            return rgba_of(pictures)[..., : _COLORS[kind]]
        channel = _CHANNELS[kind]
        if channel == "normal":
            in_view = torch.as_tensor(pictures.normal)
            return in_view @ data.viewmats[:, None, :3, :3].to(in_view)
        if channel == "depth":
            depth = torch.as_tensor(pictures.depth)
            values = depth
            if kind == RenderBufferKind.DISTANCE_TO_CAMERA:
                values = torch.as_tensor(pictures.distance)
            return torch.where(depth > 0, values, self.cfg.depth_background)[..., None]
        if channel == "label":
            return torch.as_tensor(pictures.label)[..., None]
        return torch.as_tensor(pictures.instance)[..., None]

    def read_output(self, render_data: RenderData, camera_data: CameraData) -> None:
        """Do nothing, because `render` has written the camera's buffers."""

    def cleanup(self, render_data: RenderData | None) -> None:
        """Release the buffers of a camera."""
        if render_data is not None:
            render_data.outputs = {}

    def close(self) -> None:
        """Release the gaussians."""
        self._renderer = None


def _translation_of(stage: Usd.Stage, path: str) -> Floats:
    """Return the translation (3,) of a prim in the world."""
    from pxr import Usd, UsdGeom  # Isaac Lab needs OpenUSD

    prim = stage.GetPrimAtPath(path)
    check("environment_prims", prim.IsValid(), f"a prim {path} in the stage, got none")
    matrix = UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default())
    return np.array(matrix.ExtractTranslation(), np.float64)
