"""Sensors that see in all directions: equirectangular cameras and spinning LiDARs."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from v3dg import _core
from v3dg._numbers import Floats, check, floats, positive, real, vector, whole
from v3dg.cameras import Camera, MatrixLike, VectorLike, is_rotation, level_axes
from v3dg.pictures import MOST_SIDE

# The core's axes of a sensor (x forward, y left, z up) in the axes of a camera (x
# right, y down, z forward).
_SENSOR_FROM_CAMERA = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
_MOST_ANGLES = 1 << 20
# A ray ends at the gaussian after which the transmittance is below this.
MIN_TRANSMITTANCE = 1e-4


@dataclass(frozen=True, eq=False)
class RayTable:
    """Rays in ascending order for the core, and their positions in the picture.

    Attributes:
        azimuth: (W,) radians in [0, 2π), ascending.
        elevation: (H,) radians, ascending.
        columns: (W,) the column of the picture for each azimuth.
        rows: (H,) the row of the picture for each elevation.
    """

    azimuth: Floats
    elevation: Floats
    columns: NDArray[np.int32]
    rows: NDArray[np.int32]

    @classmethod
    def of(cls, azimuth: Floats, elevation: Floats) -> "RayTable":
        """Return the table of angles in any order."""
        turned = np.mod(azimuth, 2 * math.pi)
        # a tiny negative angle rounds up to a full turn
        turned[turned >= 2 * math.pi] = 0.0
        column_order = np.argsort(turned, kind="stable")
        row_order = np.argsort(elevation, kind="stable")
        return cls(
            azimuth=turned[column_order],
            elevation=elevation[row_order],
            columns=column_order.astype(np.int32),
            rows=row_order.astype(np.int32),
        )

    def core(self, near: float, far: float, spacing: float) -> _core.RaySensor:
        """Return the rays for the compiled operations."""
        return _core.RaySensor(
            azimuth=self.azimuth,
            elevation=self.elevation,
            rows=self.rows,
            columns=self.columns,
            near=near,
            far=far,
            spacing=spacing,
            min_transmittance=MIN_TRANSMITTANCE,
        )


@dataclass(frozen=True, eq=False)
class EquirectangularCamera:
    """Camera that sees all directions, in the equirectangular projection.

    Columns are longitudes. The camera looks along z at the middle of the picture, and
    the right border is half a turn to the right. Rows are latitudes, from -y (up) in
    the first to y in the last. Pixel (i, j) has its centre at (i + ½, j + ½).

    Gaussians are not projected, but evaluated on the ray of each pixel. A gaussian
    contributes its largest value on the ray, and gaussians are blended in the order of
    the distances of these values. Therefore the picture has no seam, and its poles are
    as exact as its equator. The tolerance of a cut, and a filter, are in pixels of the
    equator.

    Args:
        viewmat: (4, 4) from world to camera, a rotation and a translation; x right, y
            down, z forward.
        width: Width in px, even and at least 8. The height is half of it.
        near: A gaussian is not seen if its largest value on a ray is nearer than this.
            In world units, > 0.

    Raises:
        ValueError: A shape or a value is invalid.
    """

    viewmat: Floats
    width: int
    near: float = 0.01
    height: int = field(init=False)

    def __post_init__(self) -> None:
        expected = f"an even number of px from 8 to {MOST_SIDE:,}"
        width = whole(self.width, "width", expected, 8, MOST_SIDE)
        check("width", width % 2 == 0, f"{expected}, got {width}")
        near = positive(self.near, "near")
        # The pinhole camera checks the pose.
        pinhole = Camera(vector(self.viewmat, "viewmat", (4, 4)), np.eye(3), 1, 1, near)
        self.__dict__.update(viewmat=pinhole.viewmat, width=width, near=near, height=width // 2)

    @classmethod
    def level(cls, camera: Camera, up: VectorLike, width: int) -> "EquirectangularCamera":
        """Return a camera at the position of another. It looks in the same direction,
        but horizontally.

        Args:
            up: (3,) direction in the world that the first row shows.

        Raises:
            ValueError: The camera looks along ``up``.
        """
        viewmat = np.eye(4)
        viewmat[:3, :3] = level_axes(camera, vector(up, "up"))
        viewmat[:3, 3] = -viewmat[:3, :3] @ camera.position
        return cls(viewmat, width, camera.near)

    @property
    def position(self) -> Floats:
        """(3,) position of the camera in the world."""
        return np.asarray(-self.viewmat[:3, :3].T @ self.viewmat[:3, 3])

    def directions(self, positions: MatrixLike) -> Floats:
        """Return the directions that are seen at positions in the image.

        Args:
            positions: (N, 2) u and v in px.

        Returns:
            (N, 3) unit vectors in camera coordinates.
        """
        pixels = floats(positions, "positions")
        is_table = pixels.ndim == 2 and pixels.shape[1] == 2
        check("positions", is_table, f"shape (N, 2), got {pixels.shape}")
        longitude = (pixels[:, 0] / self.width - 0.5) * 2 * math.pi
        latitude = (0.5 - pixels[:, 1] / self.height) * math.pi
        across = np.cos(latitude)
        return np.column_stack(
            [across * np.sin(longitude), -np.sin(latitude), across * np.cos(longitude)]
        )

    @cached_property
    def table(self) -> RayTable:
        """The rays of the pixels."""
        longitude = ((np.arange(self.width) + 0.5) / self.width - 0.5) * 2 * math.pi
        latitude = (0.5 - (np.arange(self.height) + 0.5) / self.height) * math.pi
        return RayTable.of(-longitude, latitude)

    @cached_property
    def core(self) -> _core.RaySensor:
        """The rays of the pixels for the compiled operations."""
        return self.table.core(self.near, math.inf, 2 * math.pi / self.width)

    @property
    def sensor_viewmat(self) -> Floats:
        """(4, 4) from the world to the sensor of the core."""
        return np.asarray(_SENSOR_FROM_CAMERA @ self.viewmat)


@dataclass(frozen=True, eq=False)
class Lidar:
    """Spinning LiDAR with one ray for every elevation (row) and azimuth (column).

    A ray has up to two returns. The gaussians on a ray are ordered by the distances of
    their largest values, and their blend weights are fractions of the light. A return
    is detected as soon as the weights after the last return add up to ``detection``. It
    consists of these gaussians, and of those that follow within the distance ``gap``.
    Its range is the distance at which half of its weight is reached. Its intensity is
    the sum of its weights times the luma (BT.709) of their colours.

    Args:
        azimuth: (W,) radians from x towards y, in any order, such as
            ``np.linspace(0, 2 * np.pi, 2048, endpoint=False)``.
        elevation: (H,) radians above the xy plane, -π/2 to π/2, in any order.
        near, far: Only gaussians whose largest values are between these distances
            return light. In world units.
        gap: How far a second return must be behind the point at which the first one was
            detected. In world units, > 0.
        detection: Minimum fraction of the light in a return, above 0 and up to 1.
        spacing: Angle in radians between rays. It determines the level of detail, and
            is the size of a pixel for filters. None means the square root of the
            smallest step of azimuth times the smallest step of elevation. Its square is
            one over the largest density of rays at the horizon.

    Raises:
        ValueError: A shape or a value is invalid, or a single ray has no spacing.
    """

    azimuth: Floats
    elevation: Floats
    near: float = 0.1
    far: float = math.inf
    gap: float = 0.5
    detection: float = 0.1
    spacing: float | None = None

    def __post_init__(self) -> None:
        azimuth = _angles(self.azimuth, "azimuth", 4 * math.pi)
        elevation = _angles(self.elevation, "elevation", math.pi / 2)
        near = positive(self.near, "near")
        far = real(self.far, "far", "a positive distance, or infinity", 5e-324)
        check("near, far", near <= far, f"near up to far, got {near:g} and {far:g}")
        detection = real(self.detection, "detection", "a share above 0, up to 1", 1e-6, 1)
        table = RayTable.of(azimuth, elevation)
        spacing = self.spacing
        if spacing is None:
            spacing = _least_spacing(table)
        angle = real(spacing, "spacing", "radians above 0, up to pi", 1e-9, math.pi)
        self.__dict__.update(
            azimuth=azimuth,
            elevation=elevation,
            near=near,
            far=far,
            gap=positive(self.gap, "gap"),
            detection=detection,
            spacing=angle,
            table=table,
        )

    # The rays in ascending order, for the core.
    table: RayTable = field(init=False, repr=False)

    @property
    def directions(self) -> Floats:
        """(H, W, 3) unit vectors in the frame of the sensor: x is at azimuth 0, z is
        up."""
        across = np.cos(self.elevation)[:, None]
        height = np.broadcast_to(
            np.sin(self.elevation)[:, None], (len(self.elevation), len(self.azimuth))
        )
        return np.stack([across * np.cos(self.azimuth), across * np.sin(self.azimuth), height], 2)

    @cached_property
    def core(self) -> _core.RaySensor:
        """The rays for the compiled operations."""
        assert self.spacing is not None
        return self.table.core(self.near, self.far, self.spacing)


def checked_pose(pose: object, name: str) -> Floats:
    """Return a pose (4, 4) from sensor to world. Raise ValueError unless it is a
    rotation and a translation."""
    matrix = vector(pose, name, (4, 4))
    check(name, matrix[3].tolist() == [0, 0, 0, 1], f"the last row 0 0 0 1, got {matrix[3]}")
    expected = "a rotation in the upper left 3x3, got a matrix that scales, shears or mirrors"
    check(name, is_rotation(matrix[:3, :3]), expected)
    return matrix


def _angles(values: Sequence[float] | Floats, name: str, limit: float) -> Floats:
    angles = floats(values, name)
    is_table = angles.ndim == 1 and 0 < len(angles) <= _MOST_ANGLES
    check(name, is_table, f"1 to {_MOST_ANGLES:,} angles, got shape {angles.shape}")
    largest = np.abs(angles).max()
    check(name, largest <= limit, f"radians from {-limit:g} to {limit:g}, got {largest:g}")
    angles.flags.writeable = False
    return angles


def _least_spacing(table: RayTable) -> float:
    """Return the geometric mean of the smallest steps of azimuth and of elevation. If
    there is only one of them, return it. Raise ValueError for a single ray."""
    azimuth_steps = np.diff(table.azimuth, append=table.azimuth[0] + 2 * math.pi)
    least_steps = []
    for steps in (azimuth_steps[azimuth_steps < math.pi], np.diff(table.elevation)):
        different = steps[steps > 1e-9]
        if len(different):
            least_steps.append(float(different.min()))
    check("spacing", least_steps, "an angle in radians for a single ray, got None")
    return math.sqrt(least_steps[0] * least_steps[-1])
