"""`v3dg.CameraBatch`: many cameras of one size, as arrays that change in place."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, cast

import numpy as np
import numpy.typing as npt

from v3dg import _core
from v3dg._device import CPU, Device, of
from v3dg._numbers import MOST_INT, check, check_type, floats, positive, whole
from v3dg.cameras import Camera

if TYPE_CHECKING:
    from collections.abc import Sequence

    from v3dg.gaussians import Array

_MOST_SIDE = 65535
_REAL = ("torch.float32", "torch.float64")
_WHOLE = ("torch.int32", "torch.int64")


class CameraBatch:
    """B cameras of one size, in the convention of `Camera`: x right, y down, z forward.
    They are pinhole cameras, unless `CameraBatch.of` made the batch.

    Arrays on the host (NumPy arrays, lists, torch tensors on the CPU) are copied,
    checked, and read-only. Torch tensors on a CUDA device stay there. They are read
    each time the batch is drawn, so they may be changed in place between pictures.
    Their values are not checked, because that would wait for the device. A camera with
    invalid values (NaN, a matrix that is not a rotation, a focal length that is not
    positive), or with an environment that the scene does not have, sees only the
    background.

    Attributes:
        viewmats: (B, 4, 4) from world to camera, rotations and translations.
        K: (B, 3, 3), or (3, 3) for all cameras: focal lengths and principal points in
            px, without skew.
        lenses: The cameras if some of them have lens distortion, which only the CPU can
            draw; otherwise None.
        width, height: Size of each image in px.
        near: Gaussians whose mean is nearer than this depth are not drawn.
        environments: (B,) the environment of each camera (see `Scene.environments`). A
            camera sees the instances of its environment and the shared ones; with -1,
            it sees only the shared ones. With None, each camera sees all instances.

    Raises:
        ValueError: A shape or a value is not as above; the message has the index of the
            camera. On a CUDA device, the dtype of an array is not one of float32 and
            float64 (or, for environments, int32 and int64), or an array is not
            contiguous.
    """

    def __init__(
        self,
        viewmats: Array | npt.ArrayLike,
        K: Array | npt.ArrayLike,
        width: int,
        height: int,
        near: float = 0.01,
        *,
        environments: Array | npt.ArrayLike | None = None,
    ) -> None:
        self.width = whole(width, "width", "a positive whole number", 1, _MOST_SIDE)
        self.height = whole(height, "height", "a positive whole number", 1, _MOST_SIDE)
        self.near = positive(near, "near")
        self.viewmats: Array
        self.K: Array
        self.environments: Array | None = None
        self.lenses: tuple[Camera, ...] | None = None
        if _is_on_device(viewmats):
            self._take_tensors(viewmats, K, environments)
        else:
            self._take_numbers(viewmats, K, environments)
        self._on_device: dict[Device, _core.Cameras] = {}

    def _take_numbers(
        self,
        viewmats: npt.ArrayLike,
        K: npt.ArrayLike,
        environments: npt.ArrayLike | None,
    ) -> None:
        """Copy arrays on the host, and check them."""
        self.viewmats = _reals(viewmats, "viewmats", (4, 4), is_one=False)
        self.K = _reals(K, "K", (3, 3), is_one=True)
        count = len(self.viewmats)
        check("K", self.K.ndim == 2 or len(self.K) == count, f"{count} cameras, got {len(self.K)}")
        lenses = np.ascontiguousarray(np.broadcast_to(self.K, (count, 3, 3)))
        fault = _core.fault_of_cameras(self.viewmats, lenses)
        if fault is not None:
            number, expected = fault
            raise ValueError(
                f"camera {number}: expected {expected}, got "
                f"viewmats {self.viewmats[number].tolist()}, K {lenses[number].tolist()}"
            )
        if environments is not None:
            self.environments = environment_numbers(environments, "environments", count)
            self.environments.flags.writeable = False
        self.viewmats.flags.writeable = False
        self.K.flags.writeable = False

    def _take_tensors(
        self, viewmats: Array, K: Array | npt.ArrayLike, environments: Array | npt.ArrayLike | None
    ) -> None:
        """Use tensors on a CUDA device without copying them. Tensors on the host are
        copied to the device."""
        import torch

        count = len(viewmats)
        self.viewmats = _tensor(viewmats, "viewmats", _REAL, [(count, 4, 4)])
        device = self.viewmats.device
        if not _is_on_device(K):
            K = torch.as_tensor(_reals(K, "K", (3, 3), is_one=True), device=device)
        self.K = _tensor(K, "K", _REAL, [(count, 3, 3), (3, 3)])
        check("K", self.K.device == device, f"a tensor on {device}, got one on {self.K.device}")
        if environments is None:
            return
        if not _is_on_device(environments):
            numbers = environment_numbers(environments, "environments", count)
            environments = torch.as_tensor(numbers, device=device)
        tensor = _tensor(environments, "environments", _WHOLE, [(count,)])
        check("environments", tensor.device == device, f"a tensor on {device}, got {tensor.device}")
        self.environments = tensor

    @classmethod
    def of(
        cls,
        cameras: Sequence[Camera],
        *,
        environments: Array | npt.ArrayLike | None = None,
    ) -> CameraBatch:
        """Return a batch of cameras with the same size and the same near plane. Cameras
        with lens distortion can only be drawn on the CPU.

        Raises:
            ValueError: There is no camera, or sizes or near planes differ.
        """
        check_type("cameras", cameras, Iterable, "a CameraBatch or a sequence of Cameras")
        cameras = list(cameras)
        check("cameras", cameras, "at least one, got none")
        for number, camera in enumerate(cameras):
            check_type(f"cameras[{number}]", camera, Camera, "a Camera")
            is_alike = form_of(camera) == form_of(cameras[0])
            expected = "the size and the near plane of cameras[0], got others; make two batches"
            check(f"cameras[{number}]", is_alike, expected)
        first = cameras[0]
        batch = cls(
            np.stack([camera.viewmat for camera in cameras]),
            np.stack([camera.K for camera in cameras]),
            first.width,
            first.height,
            first.near,
            environments=environments,
        )
        if any(camera.is_distorted for camera in cameras):
            batch.lenses = tuple(cameras)
        return batch

    def __len__(self) -> int:
        return len(self.viewmats)

    def __repr__(self) -> str:
        return f"CameraBatch({len(self)} cameras of {self.width}x{self.height}, {self.device})"

    @property
    def device(self) -> Device:
        """The device of the poses."""
        return of(self.viewmats)

    def core_on(self, device: Device) -> _core.Cameras:
        """Return the cameras for the compiled operations of a device.

        Raises:
            ValueError: The tensors are on another CUDA device; or the device is the
                CPU, and the tensors are not; or the device is not the CPU, and cameras
                have lens distortion.
        """
        is_drawn = self.lenses is None or not device.is_cuda
        check("cameras", is_drawn, "pinholes on a CUDA device, got lenses; draw them one by one")
        expected = f"tensors on {device}, which draws, got some on {self.device}"
        check("cameras", self.device in (CPU, device), expected)
        if device not in self._on_device:
            self._on_device[device] = self._make_core(device)
        return self._on_device[device]

    def _make_core(self, device: Device) -> _core.Cameras:
        def place(array: Array) -> Array:
            if not device.is_cuda or _is_on_device(array):
                return array
            import torch

            # This is a copy, because torch warns about read-only arrays.
            return torch.as_tensor(np.array(array), device=str(device))

        environments = None
        if self.environments is not None:
            environments = place(self.environments)
        lenses = None
        if self.lenses is not None:
            lenses = [camera.core for camera in self.lenses]
        return _core.Cameras(
            viewmats=place(self.viewmats),
            K=place(self.K),
            width=self.width,
            height=self.height,
            near=self.near,
            environments=environments,
            lenses=lenses,
        )


def form_of(camera: Camera) -> tuple[int, int, float]:
    """Return the properties that all cameras of a batch share."""
    return camera.width, camera.height, camera.near


def _is_on_device(array: object) -> bool:
    return bool(getattr(array, "is_cuda", False))


def _reals(
    values: npt.ArrayLike, name: str, shape: tuple[int, int], *, is_one: bool
) -> npt.NDArray[np.float64]:
    """Return a copy as doubles, (B, ...).

    If allowed, the array may also be a single matrix for all cameras.
    """
    try:
        array = floats(values, name)
    except ValueError:
        array = _with_any_values(values, name)
    fits = array.shape[1:] == shape and array.ndim == 3
    if is_one and array.shape == shape:
        fits = True
    expected = f"shape {('B', *shape)}".replace("'", "")
    check(name, fits, f"{expected}, got {array.shape}")
    return array


def _with_any_values(values: npt.ArrayLike, name: str) -> npt.NDArray[np.float64]:
    """Return numbers that may be NaN or infinite; a later check names the camera. For
    anything but numbers, raise the error of `floats`."""
    if hasattr(values, "detach"):
        values = cast("Array", values).numpy(force=True)
    array = np.array(values)
    if array.dtype.kind != "f":
        floats(values, name)
    return np.array(array, np.float64, order="C")


def environment_numbers(values: npt.ArrayLike, name: str, count: int) -> npt.NDArray[np.int32]:
    """Return (count,) a copy of the environments of cameras on the host; ValueError for
    other values than whole numbers from -1 on."""
    if hasattr(values, "detach"):
        values = cast("Array", values).numpy(force=True)
    array = np.asarray(values)
    fits = array.dtype.kind in "iu" and array.shape == (count,)
    expected = f"{count} whole numbers, one for each camera"
    check(name, fits, f"{expected}, got {array.dtype} of shape {array.shape}")
    wrong = (array < -1) | (array > MOST_INT)
    if wrong.any():
        number = int(np.argmax(wrong))
        raise ValueError(f"{name}[{number}]: expected -1 or more, got {array[number]}")
    return array.astype(np.int32)


def _tensor(
    tensor: Array, name: str, dtypes: tuple[str, ...], shapes: list[tuple[int, ...]]
) -> Array:
    """Return a tensor on a CUDA device without its gradient. Raise ValueError for
    another dtype, shape or layout."""
    shape = tuple(tensor.shape)
    expected = " or ".join(map(str, shapes))
    check(name, shape in shapes, f"shape {expected}, got {shape}")
    check(name, str(tensor.dtype) in dtypes, f"{' or '.join(dtypes)}, got {tensor.dtype}")
    check(name, tensor.is_contiguous(), "a contiguous tensor, got a strided one")
    return tensor.detach()
