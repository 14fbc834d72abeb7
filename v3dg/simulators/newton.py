"""Newton: a camera sensor beside `newton.sensors.SensorCamera` that rasterizes
gaussians, with a view in each world."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from v3dg import _device, _extras
from v3dg._numbers import check, check_type, floats, whole
from v3dg.camera_batch import CameraBatch
from v3dg.gaussians import Gaussians
from v3dg.levels import BuildConfig, build_bundle
from v3dg.render import MeshLayer, RenderedBatch, Renderer
from v3dg.scene import Scene
from v3dg.simulators._colors import rgba_of
from v3dg.simulators._instances import free_ids
from v3dg.simulators._poses import product_of, rotations_of, write_viewmats

try:
    import newton
    import warp
except ImportError as error:
    raise ImportError(_extras.missing("newton")) from error

from v3dg.simulators._streams import torch_in_order

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt
    import torch

    from v3dg.bundle import Bundle
    from v3dg.render.sensor import Channel

NO_SHAPE = 0xFFFFFFFF
"""The shape index of pixels without a shape, as in Newton."""
FIRST_SHAPE = 1 << 24
"""A shape that is drawn as a mesh is the instance of this number plus its index."""
_WORLD = -1


def gaussians_of(gaussian: newton.Gaussian) -> Gaussians:
    """Return Newton's gaussians, for `build_bundle`.

    Raises:
        ValueError: Their colours are in linear light.
    """
    is_display = gaussian.sh_color_space == newton.utils.ColorSpace.SRGB
    check("gaussian", is_display, "colours in sRGB, got linear ones; load it with colours in sRGB")
    count = gaussian.count
    table = np.asarray(gaussian.sh_coeffs, np.float32)
    higher = table[:, 3:].reshape(count, 3, -1).transpose(0, 2, 1)  # channel by channel
    return Gaussians(
        means=np.array(gaussian.positions, np.float32),
        quats=np.ascontiguousarray(np.roll(gaussian.rotations, 1, axis=1), np.float32),
        scales=np.array(gaussian.scales, np.float32),
        opacities=np.array(gaussian.opacities, np.float32),
        sh=np.ascontiguousarray(np.concatenate([table[:, None, :3], higher], axis=1)),
    )


class SplatCamera:
    """Camera sensor for a model of Newton, with the calls of Newton's `SensorCamera`.

    The shapes of type GAUSSIAN of the model are instances of one bundle for each
    distinct `newton.Gaussian`: they move with their bodies, and belong to the
    environment of their world, or to all if they belong to none. Further instances may
    be added to `scene` and attached to bodies. Other shapes are not drawn: pass
    pictures of Newton's `SensorCamera` as `mesh` (see `mesh_layer`).

    Everything happens on the model's device, in order with warp's current stream.

    Args:
        model: A finalized model.
        width: Width of the pictures in px.
        height: Height of the pictures in px.
        camera_fov: Vertical field of view in radians; or K.
        K: (3, 3), or (V, 3, 3) for views: focal lengths and principal points in px.
        near: As in `v3dg.CameraBatch`.
        background: Colour behind the gaussians.
        tolerance: As in `v3dg.Renderer.render_batch`.
        config: How levels of the model's gaussians are built; None means the default.

    Attributes:
        scene: The instances. Those of the model's shapes come first.

    Raises:
        ImportError: torch is not installed.
        ValueError: An argument is invalid, or a shape's scale is not uniform.
    """

    def __init__(
        self,
        model: newton.Model,
        *,
        width: int,
        height: int,
        camera_fov: float | None = None,
        K: npt.ArrayLike | None = None,
        near: float = 0.01,
        background: Sequence[float] = (0.0, 0.0, 0.0),
        tolerance: float | None = None,
        config: BuildConfig | None = None,
    ) -> None:
        _extras.load("torch")
        check_type("model", model, newton.Model, "a newton.Model")
        self.scene = Scene()
        self._model = model
        self._device = str(model.device)
        self._width = whole(width, "width", "a positive whole number", 1)
        self._height = whole(height, "height", "a positive whole number", 1)
        self._K = _intrinsics_of(camera_fov, K, self._width, self._height)
        self._near = near
        self._background = background
        self._tolerance = tolerance
        self._instances: list[int] = []
        self._bodies: list[int] = []
        self._offsets: list[npt.NDArray[np.float32]] = []  # x y z, and x y z w
        self._tensors: _Attached | None = None
        self._shapes = self._add_shapes(config)  # of instances
        self._renderer: Renderer | None = None

    def _add_shapes(self, config: BuildConfig | None) -> list[int]:
        """Add the gaussians of the model to the scene; return their shapes."""
        model = self._model
        bundles: dict[int, Bundle] = {}
        types = model.shape_type.numpy()
        scales = model.shape_scale.numpy()
        worlds = model.shape_world.numpy()
        shapes: list[int] = np.flatnonzero(types == int(newton.GeoType.GAUSSIAN)).tolist()
        for shape in shapes:
            source = model.shape_source[shape]
            if id(source) not in bundles:
                bundles[id(source)] = build_bundle(
                    gaussians_of(source), config=config, progress=False, device=self._device
                )
            scale = scales[shape]
            name = f"model.shape_scale[{shape}]"
            check(name, np.ptp(scale) == 0 < scale[0], f"a uniform scale, got {scale.tolist()}")
            self.scene.add(
                bundles[id(source)],
                np.zeros(3),
                scales=float(scale[0]),
                environment=int(worlds[shape]),
            )
        bodies = model.shape_body.numpy()[shapes]
        transforms = model.shape_transform.numpy()[shapes]
        self.attach(np.arange(len(shapes)), bodies, transforms)
        return shapes

    def attach(
        self,
        instances: npt.ArrayLike,
        bodies: npt.ArrayLike,
        transforms: npt.ArrayLike = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
    ) -> None:
        """Attach instances of `scene` to bodies, from the next `update` on.

        Args:
            instances: (M,) ids, as `Scene.add` returns them.
            bodies: (M,) indices of bodies, or one for all; -1 is the world.
            transforms: (M, 7), or (7,) for all: from instance to body, x y z and the
                quaternion x y z w, as Newton's.

        Raises:
            ValueError: There is no such body or instance, or an instance is attached
                already.
        """
        ids = free_ids(instances, self.scene, self._instances)
        count = len(ids)
        numbers = np.broadcast_to(np.asarray(bodies, np.int64), count)
        last = self._model.body_count - 1
        fits = bool(((numbers >= _WORLD) & (numbers <= last)).all())
        check("bodies", fits, f"indices from -1 to {last}, got {numbers.tolist()}")
        table = floats(transforms, "transforms")
        fits = table.shape in ((7,), (count, 7))
        check("transforms", fits, f"shape ({count}, 7) or (7,), got {table.shape}")
        self._instances += ids.tolist()
        self._bodies += numbers.tolist()
        self._offsets += list(np.broadcast_to(table, (count, 7)).astype(np.float32))
        self._tensors = None

    def update(
        self,
        state: newton.State,
        camera_transforms: warp.array,
        *,
        world_indices: warp.array | None = None,
        color_image: warp.array | None = None,
        depth_image: warp.array | None = None,
        forward_depth_image: warp.array | None = None,
        shape_index_image: warp.array | None = None,
        normal_image: warp.array | None = None,
        mesh: MeshLayer | None = None,
    ) -> RenderedBatch:
        """Draw V views. Images are written as Newton's `SensorCamera.update` does, and
        have 0 where nothing is drawn, `shape_index_image` `NO_SHAPE`.

        Args:
            state: The poses of the bodies.
            camera_transforms: (V,) transformf: cameras in the world, which look along
                -z, with y up.
            world_indices: (V,) int32: the world of each view; it sees the shapes of
                that world and those of none. None means that view i shows world i.
            color_image: (V, H, W) uint32, bytes red, green, blue, coverage.
            depth_image: (V, H, W) float32: distance along the ray.
            forward_depth_image: (V, H, W) float32: depth along the camera's axis.
            shape_index_image: (V, H, W) uint32: the shape with the largest weight;
                `NO_SHAPE` for instances that belong to no shape, and for meshes.
            normal_image: (V, H, W) vec3f in the world.
            mesh: Meshes among the gaussians; on CUDA devices, meshes and the channels
                other than depth are drawn as far as `Renderer.render_batch` supports
                them.

        Returns:
            The pictures, NumPy arrays or torch tensors on the model's device.

        Raises:
            ValueError: An argument has another shape, or is on another device.
        """
        with torch_in_order(self._model.device):
            self._move(state)
            cameras = self._cameras(camera_transforms, world_indices)
            images: dict[Channel, tuple[warp.array | None, ...]] = {
                "depth": (depth_image, forward_depth_image),
                "instance": (shape_index_image,),
                "normal": (normal_image,),
            }
            channels = [
                name for name, used in images.items() if any(image is not None for image in used)
            ]
            pictures = self._draw(cameras, channels, mesh)
            if color_image is not None:
                _write(color_image, "color_image", _packed(pictures))
            if depth_image is not None:
                _write(depth_image, "depth_image", pictures.distance)
            if forward_depth_image is not None:
                _write(forward_depth_image, "forward_depth_image", pictures.depth)
            if shape_index_image is not None:
                shapes = self._shape_indices(pictures.instance)
                _write(shape_index_image, "shape_index_image", shapes)
            if normal_image is not None:
                _write(normal_image, "normal_image", _in_world(pictures.normal, cameras))
        return pictures

    def _draw(
        self, cameras: CameraBatch, channels: Sequence[Channel], mesh: MeshLayer | None
    ) -> RenderedBatch:
        if self._renderer is None:
            place = _device.resolve(self._device)
            self._renderer = Renderer(self.scene, device=place, memory=None)
        return self._renderer.render_batch(
            cameras,
            background=self._background,
            tolerance=self._tolerance,
            channels=tuple(channels),
            mesh=mesh,
        )

    def _move(self, state: newton.State) -> None:
        """Move instances to where their bodies are."""
        if not self._instances:
            return
        if self._tensors is None:
            self._tensors = _Attached(self._instances, self._bodies, self._offsets, self._device)
        attached = self._tensors
        positions, quaternions = attached.poses(state)
        self.scene.move(attached.instances, positions=positions, quaternions=quaternions)

    def _cameras(self, transforms: warp.array, worlds: warp.array | None) -> CameraBatch:
        """Return the views as cameras that look along z, with y down."""
        import torch

        table = _tensor_of(transforms, "camera_transforms", self._device)
        check("camera_transforms", table.ndim == 2, f"shape (V,), got {tuple(transforms.shape)}")
        count = len(table)
        columns = rotations_of(table[:, 3:]).transpose(1, 2)
        signs = torch.tensor([[1.0], [-1.0], [-1.0]], device=table.device)
        viewmats = torch.eye(4, device=table.device).repeat(count, 1, 1)
        write_viewmats(viewmats, table[:, :3], columns * signs)
        if worlds is None:
            num_worlds = self._model.world_count
            expected = f"at most {num_worlds} views, one a world, got {count}"
            check("camera_transforms", count <= num_worlds, expected)
            environments = torch.arange(count, device=table.device)
        else:
            environments = _tensor_of(worlds, "world_indices", self._device).clamp(min=-1)
        return CameraBatch(
            viewmats, self._K, self._width, self._height, self._near, environments=environments
        )

    def _shape_indices(self, instances: torch.Tensor | npt.NDArray[np.int32]) -> torch.Tensor:
        """Return the shapes of instances (V, H, W), as int64."""
        import torch

        numbers = torch.as_tensor(instances)
        shapes = torch.tensor([*self._shapes, NO_SHAPE], device=numbers.device)
        count = len(self._shapes)
        is_shape = (numbers >= 0) & (numbers < count)
        return shapes[torch.where(is_shape, numbers, count).long()]


class _Attached:
    """Attached instances as tensors on the device of a model."""

    def __init__(
        self,
        instances: list[int],
        bodies: list[int],
        offsets: list[npt.NDArray[np.float32]],
        device: str,
    ) -> None:
        import torch

        self.instances = torch.tensor(instances, device=device)
        self._bodies = torch.tensor(bodies, device=device)
        self._offsets = torch.tensor(np.array(offsets), device=device)

    def poses(self, state: newton.State) -> tuple[torch.Tensor, torch.Tensor]:
        """Return positions (M, 3) and quaternions (M, 4) w x y z in the world."""
        import torch

        identity = torch.tensor([[0.0, 0, 0, 0, 0, 0, 1]], device=self._offsets.device)
        bodies = identity
        if state.body_q is not None:
            bodies = torch.cat([warp.to_torch(state.body_q), identity])  # -1 is the last
        poses = bodies[self._bodies]
        turns = poses[:, 3:]
        shifts = (rotations_of(turns) @ self._offsets[:, :3, None])[:, :, 0]
        quaternions = product_of(turns, self._offsets[:, 3:])
        return poses[:, :3] + shifts, quaternions.roll(1, dims=1)


def _intrinsics_of(
    camera_fov: float | None, K: npt.ArrayLike | None, width: int, height: int
) -> npt.NDArray[np.float64]:
    """Return K of a vertical field of view, or a given K."""
    is_one = (camera_fov is None) != (K is None)
    check("camera_fov, K", is_one, "one of them, got both or neither")
    if camera_fov is None:
        return floats(K, "K")
    check("camera_fov", 0 < camera_fov < np.pi, f"radians from 0 to pi, got {camera_fov}")
    focal = 0.5 * height / np.tan(0.5 * camera_fov)
    return np.array([[focal, 0, 0.5 * width], [0, focal, 0.5 * height], [0, 0, 1]])


def _tensor_of(array: warp.array, name: str, device: str) -> torch.Tensor:
    """Return a warp array as a tensor without copying."""
    check_type(name, array, warp.array, "a warp array")
    is_here = str(array.device) == device
    check(name, is_here, f"an array on {device}, the model's device, got one on {array.device}")
    tensor: torch.Tensor = warp.to_torch(array, requires_grad=False)
    return tensor


def _write(image: warp.array, name: str, values: torch.Tensor | npt.NDArray[np.generic]) -> None:
    """Copy values into an image of Newton."""
    import torch

    tensor = torch.as_tensor(values)
    check_type(name, image, warp.array, "a warp array")
    target = warp.to_torch(image, requires_grad=False)
    shape = tuple(target.shape)
    check(name, shape == tuple(tensor.shape), f"shape {tuple(tensor.shape)}, got {shape}")
    is_kind = target.dtype.is_floating_point == tensor.dtype.is_floating_point
    check(name, is_kind, f"values like {tensor.dtype}, got {target.dtype}")
    target.copy_(tensor)


def _packed(pictures: RenderedBatch) -> torch.Tensor:
    """Return colours (V, H, W), red in the lowest byte and coverage in the highest."""
    import torch

    values = rgba_of(pictures).long()
    factors = torch.tensor([1, 1 << 8, 1 << 16, 1 << 24], device=values.device)
    return (values * factors).sum(dim=-1)


def _in_world(
    normals: torch.Tensor | npt.NDArray[np.float32], cameras: CameraBatch
) -> torch.Tensor:
    """Return normals (V, H, W, 3) in the world from those in the axes of cameras."""
    import torch

    in_view = torch.as_tensor(normals)
    viewmats = cameras.viewmats
    if not in_view.is_cuda:
        viewmats = np.array(viewmats)  # a copy, because torch warns of read-only arrays
    rotations = torch.as_tensor(viewmats)[:, None, :3, :3].to(in_view.dtype)
    return in_view @ rotations


def mesh_layer(
    color_image: warp.array,
    forward_depth_image: warp.array,
    *,
    shape_index_image: warp.array | None = None,
) -> MeshLayer:
    """Return pictures (V, H, W) of Newton's `SensorCamera` as meshes among gaussians.
    Hide the gaussians of the model from `SensorCamera`, so that they are not drawn
    twice: a shape with `is_visible=False` is drawn by `SplatCamera` only.

    Args:
        color_image: uint32, with bytes in sRGB.
        forward_depth_image: Depth along the camera's axis, 0 where nothing is.
        shape_index_image: Its numbers become the channel `instance`, plus 2^24.
    """
    depth = forward_depth_image.numpy()
    packed = color_image.numpy()
    shifted = packed[..., None] >> np.array([0, 8, 16], np.uint32)
    instance = None
    if shape_index_image is not None:
        shapes = shape_index_image.numpy().astype(np.int64)
        instance = np.where(shapes == NO_SHAPE, -1, shapes + FIRST_SHAPE)
    return MeshLayer(
        color=(shifted & 0xFF).astype(np.float32) / 255, depth=depth, instance=instance
    )
