"""Channels of pictures other than colour, and layers of meshes that are combined with
gaussians. docs/sensors.md defines them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias, cast, get_args

import numpy as np

from v3dg import _core
from v3dg._device import CPU, Device
from v3dg._numbers import MOST_FLOAT, check, check_type, one_of
from v3dg.cameras import Camera, StereoCamera

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt
    import torch

    from v3dg._device import HostArray
    from v3dg.gaussians import Array

Channel: TypeAlias = Literal[
    "depth", "median_depth", "normal", "instance", "label", "weight", "clipped"
]
"""A channel that is drawn in addition to colour and alpha."""

Meshes: TypeAlias = "MeshLayer | Sequence[MeshLayer]"
"""The meshes of one picture, or of several."""

CHANNELS: tuple[Channel, ...] = get_args(Channel)
MESH = -2
"""The value of the channel `instance` where a mesh without ids has the largest
weight."""


class _Planes(NamedTuple):
    """The planes of a layer of meshes: float32 and int32, on one device."""

    color: Array
    depth: Array
    coverage: Array | None
    normal: Array | None
    instance: Array | None
    label: Array | None


@dataclass(frozen=True, eq=False)
class MeshLayer:
    """A picture of meshes with its z-buffer, for the same camera. Any renderer may have
    drawn it.

    Gaussians behind the meshes are hidden, and those in front are blended over them.
    The planes are (H, W) for one camera, (2, H, W) for the eyes of a stereo camera, or
    (B, H, W) for a list or a batch of cameras. They are arrays or torch tensors. If the
    depth is a tensor on a CUDA device, all planes must be tensors on that device. They
    are read when the picture is drawn, without copies to the host. Their values are not
    checked; where the depth is not positive and finite, or the coverage is NaN, there
    is no mesh. All other planes are checked on the host.

    Attributes:
        color: (..., 3) colour of the meshes, not multiplied by coverage: floats, 1 for
            white, or uint8, 255 for white.
        depth: (...) depth of the meshes along the camera's axis, in world units. A
            gaussian is in front if its mean has a smaller depth.
        coverage: (...) fraction of the pixel that meshes cover, 0 to 1. None means 1
            where the depth is positive and finite, and 0 elsewhere.
        normal: (..., 3) normals of any length in the axes of the camera (x right, y
            down, z forward). None means that meshes contribute no normals.
        instance: (...) whole numbers for the channel `instance`; None means `MESH`.
        label: (...) whole numbers for the channel `label`; None means -1.
        light: The light in which `color` is stored and is mixed with gaussians:
            "display" (sRGB, in which gaussians are trained) or "linear". The resulting
            picture is in display light in both cases.
    """

    color: Array
    depth: Array
    coverage: Array | None = None
    normal: Array | None = None
    instance: Array | None = None
    label: Array | None = None
    light: Literal["display", "linear"] = "display"

    def of_picture(self, number: int) -> MeshLayer:
        """Return the layer of one of several pictures."""

        def plane(of_all: Array | None) -> Array | None:
            if of_all is None:
                return None
            return of_all[number]

        return MeshLayer(
            color=self.color[number],
            depth=self.depth[number],
            coverage=plane(self.coverage),
            normal=plane(self.normal),
            instance=plane(self.instance),
            label=plane(self.label),
            light=self.light,
        )

    @staticmethod
    def joined(layers: Sequence[MeshLayer]) -> MeshLayer:
        """Return the layer (B, H, W) of layers (H, W).

        Raises:
            ValueError: The layers have different planes, sizes or light.
        """
        for number, layer in enumerate(layers):
            expected = f"{layers[0].light!r} as in the first layer, got {layer.light!r}"
            check(f"mesh[{number}].light", layer.light == layers[0].light, expected)

        def plane(name: str) -> Array | None:
            return _joined([getattr(layer, name) for layer in layers], name)

        color = plane("color")
        depth = plane("depth")
        assert color is not None
        assert depth is not None
        return MeshLayer(
            color=color,
            depth=depth,
            coverage=plane("coverage"),
            normal=plane("normal"),
            instance=plane("instance"),
            label=plane("label"),
            light=layers[0].light,
        )

    def core_on(self, device: Device) -> _core.Mesh:
        """Return the layer for the compiled operations on a device.

        Raises:
            ValueError: A plane has the wrong shape or values.
        """
        if device.is_cuda and _is_on_cuda(self.depth):
            planes = self._planes_there(device)
        elif device.is_cuda:
            planes = _Planes(*(_on_device(plane, device) for plane in self._planes))
        else:
            planes = self._planes
        return _core.Mesh(
            color=planes.color,
            depth=planes.depth,
            coverage=planes.coverage,
            normal=planes.normal,
            instance=planes.instance,
            label=planes.label,
            is_linear=self.light == "linear",
        )

    @cached_property
    def _planes(self) -> _Planes:
        """Return the planes on the host, after checking them."""
        one_of(self.light, "mesh.light", ("display", "linear"))
        depth = _numbers(self.depth, "depth")
        shape = depth.shape
        check("mesh.depth", depth.ndim in (2, 3), f"shape (H, W) or (B, H, W), got {shape}")
        coverage = self._coverage(depth)
        is_wrong = (coverage > 0) & ~((depth > 0) & (depth <= MOST_FLOAT))
        _refuse_any(depth, is_wrong, "depth", "positive finite depths where there is coverage")
        color = _colors(self.color, (*shape, 3))
        _refuse_any(color, ~np.isfinite(color), "color", "finite numbers")
        return _Planes(
            color=color,
            depth=depth,
            coverage=coverage,
            normal=self._unit_normals(shape),
            instance=_ids(self.instance, "instance", shape),
            label=_ids(self.label, "label", shape),
        )

    def _planes_there(self, device: Device) -> _Planes:
        """Return planes that are tensors on a device, without waiting for the
        device."""
        one_of(self.light, "mesh.light", ("display", "linear"))
        shape = tuple(self.depth.shape)
        check("mesh.depth", len(shape) in (2, 3), f"shape (H, W) or (B, H, W), got {shape}")
        return _Planes(
            color=_color_tensor(self.color, (*shape, 3), device),
            depth=_tensor(self.depth, "depth", shape, device, "float32"),
            coverage=_tensor(self.coverage, "coverage", shape, device, "float32"),
            normal=_tensor(self.normal, "normal", (*shape, 3), device, "float32"),
            instance=_tensor(self.instance, "instance", shape, device, "int32"),
            label=_tensor(self.label, "label", shape, device, "int32"),
        )

    def _coverage(self, depth: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        if self.coverage is None:
            return ((depth > 0) & np.isfinite(depth)).astype(np.float32)
        coverage = _numbers(self.coverage, "coverage", depth.shape)
        _refuse_any(coverage, (coverage < 0) | (coverage > 1), "coverage", "numbers from 0 to 1")
        return coverage

    def _unit_normals(self, shape: tuple[int, ...]) -> npt.NDArray[np.float32] | None:
        if self.normal is None:
            return None
        normal = _numbers(self.normal, "normal", (*shape, 3))
        _refuse_any(normal, ~np.isfinite(normal), "normal", "finite numbers")
        length = np.linalg.norm(normal.astype(np.float64), axis=-1, keepdims=True)
        return np.ascontiguousarray(normal / np.where(length > 0, length, 1), np.float32)


def _joined(planes: list[Array | None], name: str) -> Array | None:
    """Return a plane of several layers; None if no layer has it."""
    for number, plane in enumerate(planes):
        is_alike = (plane is None) == (planes[0] is None)
        check(f"mesh[{number}].{name}", is_alike, "a plane in every layer or in none")
    present = [plane for plane in planes if plane is not None]
    if not present:
        return None
    if all(map(_is_on_cuda, present)):
        import torch

        return cast("Array", torch.stack(cast("list[torch.Tensor]", present)))
    return cast("Array", np.stack([_array(plane, name) for plane in present]))


def _is_on_cuda(plane: Array) -> bool:
    return bool(getattr(plane, "is_cuda", False))


def _tensor(
    plane: Array | None,
    name: str,
    shape: tuple[int, ...],
    device: Device,
    dtype: Literal["float32", "int32"],
) -> torch.Tensor | None:
    """Return a plane on a device as a contiguous tensor of a dtype; None stays None.
    Raise ValueError for a plane of another shape, on another device or of another
    kind."""
    if plane is None:
        return None
    import torch

    is_there = isinstance(plane, torch.Tensor) and str(plane.device) == str(device)
    text = f"a tensor on {device}, as the depth is"
    check(f"mesh.{name}", is_there, f"{text}, got {_kind_of(plane)}")
    tensor: torch.Tensor = plane
    check(f"mesh.{name}", tuple(tensor.shape) == shape, f"shape {shape}, got {tuple(tensor.shape)}")
    is_whole = tensor.dtype in (torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64)
    fits = is_whole or (dtype == "float32" and tensor.dtype.is_floating_point)
    check(f"mesh.{name}", fits, f"numbers for {dtype}, got {tensor.dtype}")
    return tensor.detach().to(getattr(torch, dtype)).contiguous()


_KINDS_OF_COLOR = "floats (white is 1) or uint8 (white is 255)"


def _color_tensor(plane: Array, shape: tuple[int, ...], device: Device) -> torch.Tensor | None:
    """Return colours on a device as float32; see `_tensor`."""
    import torch

    colors = _tensor(plane, "color", shape, device, "float32")
    dtype = cast("torch.Tensor", plane).dtype
    if dtype == torch.uint8:
        return cast("torch.Tensor", colors) / 255
    check("mesh.color", dtype.is_floating_point, f"{_KINDS_OF_COLOR}, got {dtype}")
    return colors


def _kind_of(plane: Array) -> str:
    device = getattr(plane, "device", None)
    if device is None:
        return type(plane).__name__
    return f"one on {device}"


def _on_device(plane: Array | None, device: Device) -> Array | None:
    if plane is None:
        return None
    import torch

    return torch.as_tensor(plane, device=str(device))


def _array(values: Array, name: str) -> HostArray:
    """Return an array or a tensor as a NumPy array.

    Raise ValueError for other types.
    """
    array: HostArray
    try:
        if hasattr(values, "detach"):
            array = values.numpy(force=True)
        else:
            array = np.asarray(values)
    except (TypeError, ValueError, RuntimeError, AttributeError):
        kind = type(values).__name__
        raise ValueError(f"mesh.{name}: expected an array of numbers, got {kind}") from None
    return array


def _numbers(
    values: Array, name: str, shape: tuple[int, ...] | None = None
) -> npt.NDArray[np.float32]:
    """Return a plane as float32. Raise ValueError for NaN or another shape."""
    array = _array(values, name)
    check(f"mesh.{name}", array.dtype.kind in "biuf", f"an array of numbers, got {array.dtype}")
    fits = shape is None or array.shape == shape
    check(f"mesh.{name}", fits, f"shape {shape}, got {array.shape}")
    with np.errstate(over="ignore"):
        plane = np.ascontiguousarray(array, np.float32)
    _refuse_any(plane, np.isnan(plane), name, "numbers")
    return plane


def _colors(values: Array, shape: tuple[int, ...]) -> npt.NDArray[np.float32]:
    """Return colours as float32; raise ValueError for whole numbers that are not
    8-bit."""
    array = _array(values, "color")
    if array.dtype == np.uint8:
        return np.divide(_numbers(array, "color", shape), 255, dtype=np.float32)
    check("mesh.color", array.dtype.kind == "f", f"{_KINDS_OF_COLOR}, got {array.dtype}")
    return _numbers(array, "color", shape)


def _ids(values: Array | None, name: str, shape: tuple[int, ...]) -> npt.NDArray[np.int32] | None:
    """Return a plane of ids as int32. Raise ValueError for other dtypes and shapes."""
    if values is None:
        return None
    array = _array(values, name)
    fits = array.dtype.kind in "iu" and array.shape == shape
    expected = f"whole numbers of shape {shape}"
    check(f"mesh.{name}", fits, f"{expected}, got {array.dtype} of shape {array.shape}")
    range_of_int32 = np.iinfo(np.int32)
    is_wrong = (array < range_of_int32.min) | (array > range_of_int32.max)
    _refuse_any(array, is_wrong, name, "whole numbers that an int32 can hold")
    return np.ascontiguousarray(array, np.int32)


def _refuse_any(
    array: npt.NDArray[np.generic], is_wrong: npt.NDArray[np.bool_], name: str, expected: str
) -> None:
    """Raise a ValueError that has the first wrong value and its index."""
    if not is_wrong.any():
        return
    place = tuple(int(number[0]) for number in np.nonzero(is_wrong))
    text = ", ".join(map(str, place))
    raise ValueError(f"mesh.{name}: expected {expected}, got {array[place]} at [{text}]")


def _one_layer(mesh: Meshes) -> MeshLayer:
    """Return a layer, or several layers as one."""
    if isinstance(mesh, MeshLayer):
        return mesh
    layers = _checked_layers(mesh)
    check("mesh", layers, "a MeshLayer, or a list of them, got an empty list")
    return MeshLayer.joined(layers)


def layers_of(mesh: Meshes | None, cameras: Sequence[Camera | StereoCamera]) -> list[MeshLayer]:
    """Return the layer of each of several cameras; empty without meshes.

    Raises:
        TypeError: `mesh` is neither a `MeshLayer` nor a sequence of them.
        ValueError: A camera has no layer, or one of another size.
    """
    if mesh is None:
        return []
    if isinstance(mesh, MeshLayer):
        shape = np.shape(mesh.depth)
        expected = f"shape (B, H, W) for a list of cameras, or a list of layers, got {shape}"
        check("mesh.depth", len(shape) == 3, expected)
        layers = [mesh.of_picture(number) for number in range(shape[0])]
    else:
        layers = _checked_layers(mesh)
    expected = f"a layer for each of {len(cameras)} cameras, got {len(layers)}"
    check("mesh", len(layers) == len(cameras), expected)
    for number, (layer, camera) in enumerate(zip(layers, cameras, strict=True)):
        shape = tuple(np.shape(layer.depth))
        size = _size_of(camera)
        expected = f"shape {size}, as the picture has, got {shape}"
        check(f"mesh[{number}].depth", shape == size, expected)
    return layers


def _checked_layers(mesh: object) -> list[MeshLayer]:
    """Return a sequence of layers; raise TypeError for others."""
    if not isinstance(mesh, list | tuple):
        check_type("mesh", mesh, MeshLayer, "a MeshLayer, or a list of them")
    layers = list(cast("Sequence[MeshLayer]", mesh))
    for number, layer in enumerate(layers):
        check_type(f"mesh[{number}]", layer, MeshLayer, "a MeshLayer")
    return layers


def _size_of(camera: Camera | StereoCamera) -> tuple[int, ...]:
    """Return the shape of the planes for the pictures of a camera."""
    if isinstance(camera, StereoCamera):
        return (2, camera.left.height, camera.left.width)
    return (camera.height, camera.width)


def sensor_of(
    channels: Sequence[Channel],
    mesh: Meshes | None,
    *,
    depth: bool,
    device: Device = CPU,
) -> tuple[bool, _core.Sensor | None]:
    """Return whether depth is drawn, and the request for other channels and meshes. The
    request is None if there are neither. The planes of the mesh are brought to a
    device. Several layers become one.

    Raises:
        TypeError: `channels` is not a sequence of names, or `mesh` is neither a
            `MeshLayer` nor a sequence of them.
        ValueError: A channel is unknown, or a plane of the mesh is invalid.
    """
    if isinstance(channels, tuple) and not channels and mesh is None:
        return bool(depth), None  # fast path for most pictures
    if not isinstance(channels, list | tuple | set | frozenset):
        kind = type(channels).__name__
        raise TypeError(f"channels: expected a sequence of names of channels, got {kind}")
    for channel in channels:
        one_of(channel, "channels", CHANNELS)
    core_mesh = None
    if mesh is not None:
        core_mesh = _one_layer(mesh).core_on(device)
    names: list[str] = [channel for channel in channels if channel != "depth"]
    sensor = None
    if names or core_mesh is not None:
        sensor = _core.Sensor(names, core_mesh)
    return bool(depth) or "depth" in channels, sensor
