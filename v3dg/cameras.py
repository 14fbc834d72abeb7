"""Cameras without or with lens distortion. They are made from matrices, from two
points, or from Blender's convention. Also makes series of cameras on a turntable."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Literal, TypeAlias, TypeGuard, TypeVar, cast, get_args

import numpy as np
import numpy.typing as npt

from v3dg import _core
from v3dg._numbers import Floats as Floats
from v3dg._numbers import check, check_type, floats, one_of, positive, real, refuse, vector, whole

T = TypeVar("T")
VectorLike: TypeAlias = Sequence[float] | npt.NDArray[np.generic]
MatrixLike: TypeAlias = Sequence[Sequence[float]] | npt.NDArray[np.generic]
Axis: TypeAlias = Literal["x", "y", "z", "-x", "-y", "-z"]
AXES: tuple[Axis, ...] = get_args(Axis)
# The names are those of COLMAP and nerfstudio.
LensModel: TypeAlias = Literal["PINHOLE", "OPENCV", "OPENCV_FISHEYE"]
LENS_MODELS: tuple[LensModel, ...] = get_args(LensModel)
# The coefficients of a distortion, in order.
OPENCV_TERMS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
FISHEYE_TERMS = ("k1", "k2", "k3", "k4")
# The order of the coefficients of OPENCV in the core.
_CORE_TERMS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
# How many coefficients each model may have.
_NUM_COEFFICIENTS: dict[LensModel, tuple[int, ...]] = {
    "PINHOLE": (0,),
    "OPENCV": (4, 5, 8),
    "OPENCV_FISHEYE": (4,),
}

DEFAULT_FOV_X = 0.785398163397448  # 45 degrees
# The near plane as a fraction of the distance to the subject, and its limits in world
# units. Float32 can represent the inverse of the smaller limit.
_NEAR_SHARE = 0.01
_MOST_NEAR = 0.01
_LEAST_NEAR = 1e-30
# more would take minutes, so a larger number is most likely a typo
_MAX_TURNTABLE_CAMERAS = 1_000_000
# How much the rows of a rotation may differ from orthonormal ones. Matrices are often
# stored as float32 text.
ROTATION_TOLERANCE = 1e-4


@dataclass(frozen=True, eq=False)
class Camera:
    """Camera in the OpenCV convention: x right, y down, z forward.

    Pixel (i, j) has its centre at (i + ½, j + ½). Matrices are copied and converted to
    double precision.

    The models are those of OpenCV's documentation of camera calibration. Points beyond
    the first fold of a lens, where its image would fold back, are not drawn.

    Args:
        viewmat: (4, 4) from world to camera, a rotation and a translation.
        K: (3, 3) focal lengths and principal point in px, without skew.
        width: Image width in px.
        height: Image height in px.
        near: Gaussians whose mean has a smaller depth than this are not drawn. In world
            units, > 0.
        distortion: Coefficients of the model in OpenCV's order. "OPENCV" has k1, k2,
            p1, p2, optionally followed by k3, or by k3 to k6. "OPENCV_FISHEYE" has k1
            to k4, and "PINHOLE" has none.
        model: "PINHOLE"; "OPENCV" with radial and tangential distortion; or
            "OPENCV_FISHEYE", whose field of view may exceed 180 degrees. The depth of a
            point is its distance from the eye for a fisheye camera, and its distance
            along the axis for the others.

    Raises:
        ValueError: A shape or a value is invalid.
    """

    viewmat: Floats
    K: Floats
    width: int
    height: int
    near: float = 0.01
    distortion: Sequence[float] = ()
    model: LensModel = "PINHOLE"
    # Focal lengths and principal point in px, from K.
    fx: float = field(init=False)
    fy: float = field(init=False)
    cx: float = field(init=False)
    cy: float = field(init=False)

    def __post_init__(self) -> None:
        viewmat = vector(self.viewmat, "viewmat", (4, 4))
        _check_rotation(viewmat[:3, :3], "viewmat", "; put scale into the scene instead")
        if viewmat[3].tolist() != [0, 0, 0, 1]:
            refuse("viewmat", f"the last row 0 0 0 1, got {_text(viewmat[3])}")
        K = vector(self.K, "K", (3, 3))
        # `tolist` returns Python numbers. For so few values, they are faster than
        # NumPy, and every frame may have a new camera.
        (fx, skew, cx), (skew_y, fy, cy), last_row = K.tolist()
        if not (fx > 0 and fy > 0):
            refuse("K", f"positive focal lengths, got {fx:g} and {fy:g}")
        is_plain = skew == 0 == skew_y and last_row == [0, 0, 1]
        check(
            "K", is_plain, "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got a matrix with skew or scale"
        )
        # One update of the dict is faster than object.__setattr__ for each field of a
        # frozen class.
        self.__dict__.update(
            viewmat=viewmat,
            K=K,
            width=_side(self.width, "width"),
            height=_side(self.height, "height"),
            near=positive(self.near, "near"),
            distortion=_coefficients(self.distortion, self.model),
            fx=fx,
            fy=fy,
            cx=cx,
            cy=cy,
        )

    @classmethod
    def look_at(
        cls,
        eye: VectorLike,
        target: VectorLike,
        up: VectorLike = (0.0, 0.0, 1.0),
        fov_x: float = DEFAULT_FOV_X,
        *,
        width: int,
        height: int,
        near: float | None = None,
    ) -> "Camera":
        """Make a camera at ``eye`` that has ``target`` at the image's centre and ``up``
        pointing upwards.

        Args:
            eye: (3,) position in the world.
            target: (3,) point in the world, not at the eye.
            up: (3,) direction in the world, not along the view.
            fov_x: Horizontal field of view in radians. Pixels are square.
            near: See `Camera`. None means a hundredth of the distance to the target,
                but at most 0.01, so that a camera can move close to a small subject.

        Raises:
            ValueError: The target is at the eye, or ``up`` lies along the view
                direction.
        """
        position = vector(eye, "eye")
        goal = vector(target, "target")
        up_vector = vector(up, "up")
        with np.errstate(over="ignore"):
            distance = np.linalg.norm(goal - position)
        check("target", distance > 0, f"a point away from the eye, got {_text(goal)} for both")
        check(
            "eye, target",
            np.isfinite(distance),
            f"points whose distance a double can hold, got {_text(position)} and {_text(goal)}",
        )
        forward = (goal - position) / distance
        # Dividing by the largest component prevents overflow and underflow of squares.
        upwards = up_vector / (np.abs(up_vector).max() or 1.0)
        right = np.cross(forward, upwards)
        length = np.linalg.norm(right)
        is_independent = length > 1e-9 * np.linalg.norm(upwards)
        check(
            "up", is_independent, f"a direction that is not along the view, got {_text(up_vector)}"
        )
        right /= length
        rotation = np.stack([right, np.cross(forward, right), forward])
        if near is None:
            near = near_of(float(distance))
        return cls(
            rigid(rotation, position), intrinsics(fov_x, None, width, height), width, height, near
        )

    @classmethod
    def from_blender(
        cls,
        transform_matrix: MatrixLike,
        fov_x: float,
        width: int,
        height: int,
        fov_y: float | None = None,
        *,
        near: float = 0.01,
    ) -> "Camera":
        """Make a camera from a camera-to-world matrix in Blender's convention: x right,
        y up, z backward.

        Args:
            transform_matrix: (4, 4) from camera to world. Its rotation is replaced by
                the nearest exact rotation.
            fov_x: Horizontal field of view in radians.
            fov_y: Vertical field of view in radians. With None, pixels are square.
        """
        K = intrinsics(fov_x, fov_y, width, height)
        return cls(viewmat_from_blender(transform_matrix), K, width, height, near)

    @property
    def position(self) -> Floats:
        """(3,) position of the camera in the world."""
        return self.core.position

    @cached_property
    def core(self) -> _core.Camera:
        """The camera for the compiled operations."""
        make = partial(
            _core.Camera,
            viewmat=self.viewmat,
            K=self.K,
            width=self.width,
            height=self.height,
            near=self.near,
        )
        if self.model == "OPENCV_FISHEYE":
            return make(model="fisheye", distortion=list(self.distortion))
        if self.is_distorted:
            terms = by_term(OPENCV_TERMS, self.distortion)
            return make(model="opencv", distortion=[terms[name] for name in _CORE_TERMS])
        return make()

    @property
    def is_distorted(self) -> bool:
        """Whether the camera has lens distortion, so that it is not a pinhole
        camera."""
        return self.model == "OPENCV_FISHEYE" or any(self.distortion)

    @property
    def pinhole(self) -> "Camera":
        """The same camera without its lens distortion."""
        return replace(self, distortion=(), model="PINHOLE")

    def directions(self, positions: MatrixLike) -> Floats:
        """Return the points at depth 1 that are seen at positions in the image.

        Args:
            positions: (N, 2) u and v in px.

        Returns:
            (N, 3) in camera coordinates. Multiply by a depth to get the point at that
            depth. NaN where the lens shows nothing.

        Raises:
            ValueError: The positions are not finite numbers, or have another shape.
        """
        pixels = floats(positions, "positions")
        is_table = pixels.ndim == 2 and pixels.shape[1] == 2
        check("positions", is_table, f"shape (N, 2), got {pixels.shape}")
        image = (pixels - (self.cx, self.cy)) / (self.fx, self.fy)
        if not self.is_distorted:
            return np.column_stack([image, np.ones(len(image))])
        if self.model == "OPENCV_FISHEYE":
            return _fisheye_directions(image, self.distortion, self.core.lens_range)
        return _opencv_directions(image, self.distortion, self.core.lens_range)

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        values = (self.viewmat, self.K, self.width, self.height, self.near)
        return Camera, (*values, self.distortion, self.model)

    def scaled(self, factor: int) -> "Camera":
        """Return this camera with ``factor`` times the resolution, for
        supersampling."""
        factor = _side(factor, "factor")
        K = self.K * np.array([[factor], [factor], [1.0]])
        return replace(self, K=K, width=self.width * factor, height=self.height * factor)

    def __repr__(self) -> str:
        lens = f"fx={self.fx:g}, fy={self.fy:g}"
        if self.is_distorted:
            lens += f", {self.model} {_text(self.distortion)}"
        return f"Camera({self.width}x{self.height}, eye={_text(self.position)}, {lens})"


@dataclass(frozen=True, eq=False)
class StereoCamera:
    """Two cameras that look the same way, like the eyes in a headset. They share one
    cut.

    Raises:
        ValueError: The cameras have different rotations, or lens distortion.
    """

    left: Camera
    right: Camera

    def __post_init__(self) -> None:
        has_same_rotation = np.array_equal(self.left.viewmat[:3, :3], self.right.viewmat[:3, :3])
        expected = (
            "a camera of the same rotation as the left one, got another; draw cameras with "
            "different rotations one by one"
        )
        check("right", has_same_rotation, expected)
        for name, camera in (("left", self.left), ("right", self.right)):
            check_pinhole(name, camera, "draw such cameras one by one")

    @classmethod
    def of(cls, camera: Camera, eye_distance: float) -> "StereoCamera":
        """Return two cameras to the left and the right of a camera, ``eye_distance``
        world units apart."""
        shift = np.zeros((4, 4))
        shift[0, 3] = 0.5 * positive(eye_distance, "eye_distance")
        left = replace(camera, viewmat=camera.viewmat + shift)
        right = replace(camera, viewmat=camera.viewmat - shift)
        return cls(left, right)

    @property
    def eyes(self) -> tuple[Camera, Camera]:
        return self.left, self.right

    @cached_property
    def core(self) -> _core.Eyes:
        """The cameras for the compiled operations."""
        return _core.Eyes(self.left.core, self.right.core)

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return StereoCamera, self.eyes


def check_camera(camera: object) -> None:
    """Raise TypeError unless a value is a camera or a stereo camera."""
    if not isinstance(camera, StereoCamera):
        check_type("camera", camera, Camera, "a Camera or a StereoCamera")


def for_each(
    camera: Camera | StereoCamera | Sequence[Camera],
    make: Callable[[Camera | StereoCamera], T],
) -> T | list[T]:
    """Return the result of ``make`` for one camera. For several cameras, return a list
    of the results."""
    if are_several(camera):
        return [make(view) for view in camera]
    return make(cast(Camera, camera))


def are_several(camera: object) -> TypeGuard[Iterable[Camera]]:
    """Return whether an argument is several cameras. An array without axes is not,
    although it is iterable."""
    return hasattr(camera, "__iter__") and getattr(camera, "ndim", 1) > 0


def check_pinhole(name: str, camera: Camera, advice: str) -> None:
    """Raise ValueError unless a camera has no lens distortion."""
    check(name, not camera.is_distorted, f"a pinhole, got {camera.model} with distortion; {advice}")


def check_cameras(cameras: object) -> None:
    """Raise TypeError unless ``cameras`` is a mapping from names to cameras."""
    check_type(
        "cameras", cameras, Mapping, "a mapping from names to cameras, such as {'front': camera}"
    )
    assert isinstance(cameras, Mapping)
    for name, camera in cameras.items():
        check_type(f"cameras[{name!r}]", camera, Camera, "a Camera")


def turntable(
    center: VectorLike,
    radius: float,
    n: int,
    elevation: float = 0.35,
    *,
    up: VectorLike = (0.0, 0.0, 1.0),
    fov_x: float = DEFAULT_FOV_X,
    width: int = 800,
    height: int = 800,
    near: float | None = None,
) -> list[Camera]:
    """Make ``n`` cameras evenly spaced on a circle around ``center``, all looking at
    ``center``.

    Args:
        center: (3,) point in the world.
        radius: Distance from the centre; > 0.
        elevation: Angle above the plane through the centre, in radians, between -π/2
            and π/2.
        up: (3,) axis of the turntable.
        fov_x: Horizontal field of view in radians.
        near: As in `Camera.look_at`.
    """
    middle = vector(center, "center")
    axis = vector(up, "up")
    radius = positive(radius, "radius")
    n = whole(n, "n", "0 cameras or more", 0, _MAX_TURNTABLE_CAMERAS)
    if not max(1e-150, 1e-12 * np.abs(middle).max()) < radius < 1e150:
        expected = "a circle that double precision resolves"
        refuse("center, radius", f"{expected}, got {radius} around {_text(middle)}")
    elevation = real(elevation, "elevation")
    if not abs(elevation) < math.pi / 2:
        refuse("elevation", f"an angle between -pi/2 and pi/2, got {elevation}")
    check("up", axis.any(), f"a direction other than zero, got {_text(axis)}")
    axis /= np.abs(axis).max()  # prevents overflow and underflow of squares
    axis /= np.linalg.norm(axis)
    # The coordinate axis with the largest angle to `up`, made perpendicular to `up`.
    start = np.eye(3)[np.argmin(np.abs(axis))]
    start = start - axis * (axis @ start)
    start /= np.linalg.norm(start)
    side = np.cross(axis, start)
    cameras = []
    for i in range(n):
        angle = 2 * math.pi * i / n
        outwards = math.cos(elevation) * (math.cos(angle) * start + math.sin(angle) * side)
        eye = middle + radius * (outwards + math.sin(elevation) * axis)
        cameras.append(
            Camera.look_at(eye, middle, axis, fov_x, width=width, height=height, near=near)
        )
    return cameras


def near_of(distance: float) -> float:
    """Return the near plane for a camera whose subject is at this distance."""
    return max(min(_MOST_NEAR, _NEAR_SHARE * distance), _LEAST_NEAR)


def rigid(rotation: Floats, eye: Floats) -> Floats:
    """Return the (4, 4) matrix from world to camera, given the rotation and the
    position of the camera."""
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation
    # `Camera` rejects infinite values later.
    with np.errstate(over="ignore", invalid="ignore"):
        viewmat[:3, 3] = -rotation @ eye
    return viewmat


def is_rotation(matrix: Floats) -> bool:
    """Return whether a (3, 3) matrix is a rotation, up to the rounding of float32
    text."""
    # Python numbers are faster here than NumPy, and every frame of a flight checks a
    # new camera.
    (a, b, c), (d, e, f), (g, h, i) = matrix.tolist()
    deviation: float = max(
        abs(a * a + b * b + c * c - 1),
        abs(d * d + e * e + f * f - 1),
        abs(g * g + h * h + i * i - 1),
        abs(a * d + b * e + c * f),
        abs(a * g + b * h + c * i),
        abs(d * g + e * h + f * i),
    )
    determinant: float = a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g)
    return deviation <= ROTATION_TOLERANCE and determinant > 0


def _check_rotation(matrix: Floats, name: str, advice: str = "") -> None:
    expected = "a rotation in the upper left 3x3, got a matrix that scales, shears or mirrors"
    check(name, is_rotation(matrix), expected + advice)


def viewmat_from_blender(transform_matrix: MatrixLike) -> Floats:
    """Convert a (4, 4) camera-to-world matrix in Blender's convention to a
    world-to-camera matrix. Its rotation is replaced by the nearest exact rotation."""
    matrix = vector(transform_matrix, "transform_matrix", (4, 4))
    axes = matrix[:3, :3] * [1.0, -1.0, -1.0]
    _check_rotation(axes, "transform_matrix")
    left, _, right = np.linalg.svd(axes)
    return rigid((left @ right).T, matrix[:3, 3])


def intrinsics(fov_x: float, fov_y: float | None, width: int, height: int) -> Floats:
    """Return (3, 3) K for fields of view in radians, with a central principal point. If
    fov_y is None, pixels are square."""
    width = _side(width, "width")
    height = _side(height, "height")
    fx = _focal(fov_x, "fov_x", width)
    fy = fx
    if fov_y is not None:
        fy = _focal(fov_y, "fov_y", height)
    return np.array([[fx, 0.0, 0.5 * width], [0.0, fy, 0.5 * height], [0.0, 0.0, 1.0]])


def level_axes(camera: Camera, up: Floats) -> Floats:
    """Return the (3, 3) rotation from the world to a level frame, in which -y is up and
    z is the horizontal direction of the camera. Raise ValueError if the camera looks
    along ``up``."""
    check("up", up.any(), "a direction other than zero, got (0, 0, 0)")
    axis = up / np.abs(up).max()  # prevents overflow and underflow of squares
    axis /= np.linalg.norm(axis)
    forward = camera.viewmat[2, :3] - axis * (camera.viewmat[2, :3] @ axis)
    length = np.linalg.norm(forward)
    check(
        "up, camera",
        length > 1e-6,
        "a camera that does not look along `up`, got parallel directions",
    )
    forward = forward / length
    return np.stack([np.cross(forward, axis), -axis, forward])


def _focal(fov: float, name: str, side: int) -> float:
    """Return the focal length in px, given a field of view in radians and the number of
    px that it spans."""
    fov = real(fov, name, "radians between 0 and pi")
    focal = math.inf
    if 0 < fov < math.pi:
        tangent = math.tan(0.5 * fov)
        if tangent > 0:
            focal = 0.5 * side / tangent
    check(name, focal < math.inf, f"radians between 0 and pi, got {fov}")
    return focal


def _side(value: int, name: str) -> int:
    return whole(value, name, "a positive whole number", 1)


def _coefficients(distortion: Sequence[float], model: LensModel) -> tuple[float, ...]:
    """Return the coefficients of a lens. Raise ValueError if their number is wrong."""
    one_of(model, "model", LENS_MODELS)
    expected = _NUM_COEFFICIENTS[model]
    values = tuple(real(value, "distortion") for value in distortion)
    numbers = " or ".join(map(str, expected))
    check(
        "distortion",
        len(values) in expected,
        f"{numbers} coefficients of {model}, got {len(values)}",
    )
    return values


def by_term(terms: Sequence[str], coefficients: Sequence[float]) -> dict[str, float]:
    """Return the coefficients of a lens by their names. Those that are left out are
    0."""
    return {**dict.fromkeys(terms, 0.0), **dict(zip(terms, coefficients, strict=False))}


def _first_reaching(radius: Floats, end: float, function: Callable[[Floats], Floats]) -> Floats:
    """Return where an increasing function reaches a value, by bisection from 0 to
    ``end``. Return NaN if it stays smaller."""
    low = np.zeros_like(radius)
    high = np.full_like(radius, end)
    is_reached = function(high) >= radius
    for _ in range(60):
        middle = (low + high) / 2
        is_above = function(middle) >= radius
        high = np.where(is_above, middle, high)
        low = np.where(is_above, low, middle)
    return np.where(is_reached, high, math.nan)


def _fisheye_directions(image: Floats, coefficients: Sequence[float], end: float) -> Floats:
    """Return unit vectors. ``image`` is in units of the focal lengths."""

    def image_radius(angle: Floats) -> Floats:
        square = angle**2
        return angle * np.polyval([*reversed(coefficients), 1.0], square)

    radius = np.hypot(image[:, 0], image[:, 1])
    angle = _first_reaching(radius, end, image_radius)
    across = np.sin(angle) / np.where(radius > 0, radius, 1)
    return np.column_stack([image * across[:, None], np.cos(angle)])


def _opencv_directions(image: Floats, coefficients: Sequence[float], end: float) -> Floats:
    """Return (x / z, y / z, 1). ``image`` is in units of the focal lengths. The radial
    distortion is inverted by bisection, and the tangential one by iteration."""
    terms = by_term(OPENCV_TERMS, coefficients)
    p1 = terms["p1"]
    p2 = terms["p2"]

    def radial_factor(square: Floats) -> Floats:
        numerator = np.polyval([terms["k3"], terms["k2"], terms["k1"], 1.0], square)
        return numerator / np.polyval([terms["k6"], terms["k5"], terms["k4"], 1.0], square)

    slopes = np.zeros_like(image)
    for _ in range(40):
        x, y = slopes.T
        square = x**2 + y**2
        shift_x = 2 * p1 * x * y + p2 * (square + 2 * x**2)
        shift_y = p1 * (square + 2 * y**2) + 2 * p2 * x * y
        radial = image - np.column_stack([shift_x, shift_y])
        radius = np.hypot(radial[:, 0], radial[:, 1])
        slope = _first_reaching(radius, end, lambda r: r * radial_factor(r**2))
        slopes = radial * (slope / np.where(radius > 0, radius, 1))[:, None]
        if not (p1 or p2):
            break
    depth = np.where(np.isnan(slopes[:, 0]), math.nan, 1.0)
    return np.column_stack([slopes, depth])


def _text(vector: Sequence[float] | Floats) -> str:
    return "(" + ", ".join(f"{v:g}" for v in vector) + ")"
