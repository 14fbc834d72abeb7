"""MuJoCo: draws its cameras and bodies in a scene of gaussians, with its meshes between
the gaussians.

MuJoCo draws its geoms with OpenGL. Without a display, set the environment variable
MUJOCO_GL to "egl" or "osmesa" before MuJoCo is imported.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from v3dg import _extras
from v3dg._numbers import check, check_type, vector, whole
from v3dg.camera_batch import CameraBatch
from v3dg.cameras import Camera, rigid
from v3dg.render import MeshLayer, Renderer
from v3dg.rotations import product, rotation_from_quaternion
from v3dg.scene import Scene
from v3dg.simulators._instances import free_ids

try:
    import mujoco
except ImportError as error:
    raise ImportError(_extras.missing("mujoco")) from error

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from v3dg.image import RenderedImage
    from v3dg.render.sensor import Channel

CameraName: TypeAlias = "str | int | mujoco.MjvCamera"
"""A camera of a model by its name or its id, or a camera of a viewer. -1 is the free
camera with which MuJoCo starts."""

FIRST_GEOM = 1 << 24
"""A geom appears as the instance with this number plus the geom's id."""
_FREE = -1
_SAME_ASPECT = 1e-3  # relative, because models are written with a few digits


def camera_of(
    model: mujoco.MjModel, data: mujoco.MjData, camera: CameraName, *, width: int, height: int
) -> Camera:
    """Return a camera of a model as MuJoCo draws it, with MuJoCo's near plane and
    intrinsics.

    Args:
        model: The model.
        data: The state of the model. `mj_forward` or a step must have computed its
            poses.
        camera: See `CameraName`.
        width: Width of the picture in px.
        height: Height of the picture in px.

    Raises:
        ValueError: There is no such camera; its projection is orthographic; its sensor
            has another aspect ratio than the picture; or its pixels are not square,
            which MuJoCo does not support.
    """
    scene = mujoco.MjvScene(model, maxgeom=1)
    mujoco.mjv_updateCamera(model, data, _view_of(model, camera), scene)
    # Use the middle between both eyes, which only differ for stereo.
    eye = mujoco.mjv_averageCamera(scene.camera[0], scene.camera[1])
    check("camera", not eye.orthographic, f"a perspective projection, got {camera!r} without")
    return _from_frustum(eye, width, height)


def _from_frustum(eye: mujoco.MjvGLCamera, width: int, height: int) -> Camera:
    """Convert a camera of OpenGL.

    Its frustum is given in world units at the near plane.
    """
    near = float(eye.frustum_near)
    bottom = float(eye.frustum_bottom)
    top = float(eye.frustum_top)
    frustum_width = (top - bottom) * width / height  # pixels are square
    sensor_width = 2 * float(eye.frustum_width) or frustum_width  # half of it, or 0
    fits = abs(sensor_width / frustum_width - 1) < _SAME_ASPECT
    expected = f"a sensor with square pixels and the aspect {width}:{height} of the picture"
    aspect = sensor_width / (top - bottom)
    check("camera", fits, f"{expected}, got a field of view of the aspect {aspect:.4g}")
    left = float(eye.frustum_center) - 0.5 * frustum_width
    focal = height * near / (top - bottom)
    K = [[focal, 0, -left / near * focal], [0, focal, top / near * focal], [0, 0, 1]]
    forward = np.array(eye.forward, np.float64)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, eye.up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Camera(rigid(rotation, np.array(eye.pos, np.float64)), np.array(K), width, height, near)


def _view_of(model: mujoco.MjModel, camera: CameraName) -> mujoco.MjvCamera:
    """Convert a camera of a model to a camera of MuJoCo's viewer."""
    if isinstance(camera, mujoco.MjvCamera):
        return camera
    view = mujoco.MjvCamera()
    number = _id_of(model, mujoco.mjtObj.mjOBJ_CAMERA, camera, "camera", _FREE)
    if number == _FREE:
        mujoco.mjv_defaultFreeCamera(model, view)
        return view
    view.type = mujoco.mjtCamera.mjCAMERA_FIXED
    view.fixedcamid = number
    return view


def _id_of(
    model: mujoco.MjModel, kind: mujoco.mjtObj, item: str | int, name: str, lowest: int
) -> int:
    """Return the id of an object of a model, given its name or its id."""
    counts = {mujoco.mjtObj.mjOBJ_CAMERA: model.ncam, mujoco.mjtObj.mjOBJ_BODY: model.nbody}
    count = counts[kind]
    if isinstance(item, str):
        number = mujoco.mj_name2id(model, kind, item)
        if number < 0:
            names = ", ".join(repr(mujoco.mj_id2name(model, kind, i)) for i in range(count))
            raise ValueError(f"{name}: expected one of {names}, got {item!r}")
        return int(number)
    return whole(item, name, f"a name, or an id from {lowest} to {count - 1}", lowest, count - 1)


def cameras_of(
    model: mujoco.MjModel,
    data: mujoco.MjData | Sequence[mujoco.MjData],
    cameras: Sequence[CameraName] | None = None,
    *,
    width: int,
    height: int,
) -> CameraBatch:
    """Return cameras of a model as a batch.

    Args:
        model: The model.
        data: One state, or E states of the model, one for each environment of a scene.
        cameras: C cameras. None means all cameras of the model.
        width: Width of the pictures in px.
        height: Height of the pictures in px.

    Returns:
        C cameras that see everything; or E x C cameras, beginning with all of the first
        environment, each of which sees its environment and the shared instances.

    Raises:
        ValueError: As for `camera_of`, or there is no camera.
    """
    names = cameras
    if names is None:
        names = range(model.ncam)
    states = data
    environments = None
    if isinstance(data, mujoco.MjData):
        states = [data]
    else:
        environments = np.repeat(np.arange(len(data)), len(names))
    views = [
        camera_of(model, state, camera, width=width, height=height)
        for state in states
        for camera in names
    ]
    return CameraBatch.of(views, environments=environments)


class Attachments:
    """Instances of a scene that move together with bodies of a model.

    Args:
        model: The model.
        scene: The scene. Several models, or several states of one model, may move
            instances of the same scene.
    """

    def __init__(self, model: mujoco.MjModel, scene: Scene) -> None:
        check_type("model", model, mujoco.MjModel, "a mujoco.MjModel")
        check_type("scene", scene, Scene, "a Scene")
        self.scene = scene
        self._model = model
        self._instances = np.zeros(0, np.int64)
        self._bodies = np.zeros(0, np.int64)
        self._positions = np.zeros((0, 3))
        self._quaternions = np.zeros((0, 4))

    def attach(
        self,
        instances: npt.ArrayLike,
        body: str | int,
        position: npt.ArrayLike = (0.0, 0.0, 0.0),
        quaternion: npt.ArrayLike = (1.0, 0.0, 0.0, 0.0),
    ) -> None:
        """Attach instances to a body. `move` then moves them.

        Args:
            instances: Ids in the scene, as `Scene.add` returns them.
            body: Name or id of the body.
            position: (3,) origin of the instances in the axes of the body.
            quaternion: (4,) w x y z, their rotation in these axes.

        Raises:
            ValueError: There is no such body or instance, or an instance is already
                attached.
        """
        ids = free_ids(instances, self.scene, self._instances)
        number = _id_of(self._model, mujoco.mjtObj.mjOBJ_BODY, body, "body", 0)
        turn = vector(quaternion, "quaternion", (4,))
        check("quaternion", turn.any(), "a rotation, got zeros")
        count = len(ids)
        places = np.tile(vector(position, "position"), (count, 1))
        turns = np.tile(turn / np.linalg.norm(turn), (count, 1))
        self._instances = np.concatenate([self._instances, ids])
        self._bodies = np.concatenate([self._bodies, np.full(count, number)])
        self._positions = np.concatenate([self._positions, places])
        self._quaternions = np.concatenate([self._quaternions, turns])

    def move(self, data: mujoco.MjData) -> None:
        """Move the instances to the positions of their bodies in a state of the model.
        Their scales do not change."""
        if not len(self._instances):
            return
        turns = np.array(data.xquat, np.float64)[self._bodies]
        rotations = rotation_from_quaternion(turns)
        offsets = (rotations @ self._positions[:, :, None])[:, :, 0]
        positions = np.array(data.xpos, np.float64)[self._bodies] + offsets
        quaternions = product(turns, self._quaternions)
        self.scene.move(self._instances, positions=positions, quaternions=quaternions)


class MeshRenderer:
    """Draws the geoms of a model as `MeshLayer`s, using MuJoCo's own renderer.

    MuJoCo draws several samples per pixel. Colours are averages of the samples,
    coverage is the fraction of samples with a geom, and ids and depth are those of the
    nearest sample. Translucent geoms count as opaque, and MuJoCo's sky is not drawn.
    Use this object as a context manager, or close it.

    Args:
        model: The model.
        width: Width of the pictures in px.
        height: Height of the pictures in px.
        samples: Number of samples of a pixel along each axis.
        option: Which geoms are visible. None means MuJoCo's default, the geom groups 0
            to 2. If gaussians show an object whose geoms are only needed for
            collisions, put these geoms into group 3.
        labels: (ngeom,) labels of the geoms for the channel `label`. None means that
            they have none.

    Raises:
        ValueError: An argument is invalid.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        *,
        width: int,
        height: int,
        samples: int = 2,
        option: mujoco.MjvOption | None = None,
        labels: npt.ArrayLike | None = None,
    ) -> None:
        check_type("model", model, mujoco.MjModel, "a mujoco.MjModel")
        self.width = whole(width, "width", "a positive whole number", 1)
        self.height = whole(height, "height", "a positive whole number", 1)
        self._samples = whole(samples, "samples", "1 to 8 samples", 1, 8)
        self._model = model
        self._option = option
        self._labels: npt.NDArray[np.int32] | None = None
        if labels is not None:
            of_geoms = np.asarray(labels)
            fits = of_geoms.dtype.kind in "iu" and of_geoms.shape == (model.ngeom,)
            check("labels", fits, f"{model.ngeom} whole numbers, got shape {of_geoms.shape}")
            self._labels = of_geoms.astype(np.int32)
        self._renderer = _make_renderer(model, width * samples, height * samples)

    def draw(self, data: mujoco.MjData, camera: CameraName = _FREE) -> MeshLayer:
        """Draw the geoms in a state of the model, for `v3dg.render(mesh=)` with the
        camera of `camera_of`."""
        renderer = self._renderer
        renderer.update_scene(data, _view_of(self._model, camera), self._option)
        colors = renderer.render()
        renderer.enable_depth_rendering()
        depths = renderer.render()
        renderer.enable_segmentation_rendering()
        objects = renderer.render()
        renderer.disable_segmentation_rendering()
        is_geom = objects[..., 1] == int(mujoco.mjtObj.mjOBJ_GEOM)
        geoms = np.where(is_geom, objects[..., 0], _FREE)
        return self._layer_of(colors, depths, geoms)

    def _layer_of(
        self,
        colors: npt.NDArray[np.uint8],
        depths: npt.NDArray[np.float32],
        geoms: npt.NDArray[np.int32],
    ) -> MeshLayer:
        """Combine the samples of each pixel."""
        color_samples = self._by_pixel(colors).astype(np.float32) / 255
        geom_samples = self._by_pixel(geoms).astype(np.int32)[..., 0]
        is_hit = geom_samples >= 0
        depth_samples = np.where(is_hit, self._by_pixel(depths)[..., 0], np.inf)
        count = is_hit.sum(axis=-1)
        share = is_hit / np.maximum(count, 1)[..., None]
        nearest = np.argmin(depth_samples, axis=-1)[..., None]
        geom = np.take_along_axis(geom_samples, nearest, axis=-1)[..., 0]
        label = None
        if self._labels is not None:
            label = np.where(geom < 0, -1, self._labels[geom])
        return MeshLayer(
            color=(share[..., None] * color_samples).sum(axis=2),
            depth=np.take_along_axis(depth_samples, nearest, axis=-1)[..., 0],
            coverage=count / self._samples**2,
            instance=FIRST_GEOM + geom,
            label=label,
        )

    def _by_pixel(self, samples: npt.NDArray[np.generic]) -> npt.NDArray[np.generic]:
        """Rearrange samples (sH, sW) or (sH, sW, C) to (H, W, S, C)."""
        side = self._samples
        shape = (self.height, side, self.width, side, -1)
        blocks = samples.reshape(shape).swapaxes(1, 2)
        return np.ascontiguousarray(blocks).reshape(self.height, self.width, side * side, -1)

    def close(self) -> None:
        """Free the resources of MuJoCo's renderer."""
        self._renderer.close()

    def __enter__(self) -> MeshRenderer:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def _make_renderer(model: mujoco.MjModel, width: int, height: int) -> mujoco.Renderer:
    """Make a renderer with a framebuffer of a given size. MuJoCo's multisampling is
    off, because it would mix the sky into samples at edges. Afterwards, the model is
    unchanged."""
    screen = model.vis.global_
    quality = model.vis.quality
    settings = (screen.offwidth, screen.offheight, quality.offsamples)
    screen.offwidth = max(screen.offwidth, width)
    screen.offheight = max(screen.offheight, height)
    quality.offsamples = 0
    try:
        return mujoco.Renderer(model, height, width)
    finally:
        screen.offwidth, screen.offheight, quality.offsamples = settings


class SplatRenderer:
    """Draws a model of MuJoCo in a scene of gaussians: its geoms as meshes, the
    gaussians that are attached to its bodies, and the rest of the scene.

    Use this object as a context manager, or close it.

    Args:
        model: The model.
        scene: The scene, in the units and the axes of the model (z up).
        width: Width of the pictures in px.
        height: Height of the pictures in px.
        samples: As in `MeshRenderer`, like `option` and `labels`.
        device: As in `v3dg.render`.

    Attributes:
        attachments: Instances that move with bodies: `attachments.attach(ids, "cup")`.
        meshes: Draws the geoms.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        scene: Scene,
        *,
        width: int = 640,
        height: int = 480,
        samples: int = 2,
        option: mujoco.MjvOption | None = None,
        labels: npt.ArrayLike | None = None,
        device: str = "auto",
    ) -> None:
        self.attachments = Attachments(model, scene)
        self._renderer = Renderer(scene, device=device)
        self._model = model
        self.meshes = MeshRenderer(
            model, width=width, height=height, samples=samples, option=option, labels=labels
        )

    def render(
        self,
        data: mujoco.MjData,
        camera: CameraName = _FREE,
        *,
        tolerance: float | None = None,
        background: Sequence[float] = (0.0, 0.0, 0.0),
        channels: Sequence[Channel] = (),
    ) -> RenderedImage:
        """Draw a state of the model.

        Args:
            data: The state of the model. `mj_forward` or a step must have computed its
                poses.
            camera: See `CameraName`.
            tolerance: As in `v3dg.render`, like `background` and `channels`. Where a
                geom has the largest weight, `instance` is `FIRST_GEOM` plus the geom's
                id.
        """
        self.attachments.move(data)
        meshes = self.meshes
        view = camera_of(self._model, data, camera, width=meshes.width, height=meshes.height)
        layer = meshes.draw(data, camera)
        return self._renderer.render(
            view, tolerance=tolerance, background=background, channels=channels, mesh=layer
        )

    def close(self) -> None:
        """Free the resources of MuJoCo's renderer."""
        self.meshes.close()

    def __enter__(self) -> SplatRenderer:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()
