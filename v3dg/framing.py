"""Chooses the first view of a subject. An object is seen from outside, and a room from
inside.

A grid of voxels is laid over most of the gaussians, and the directions that are blocked
from each place are counted (ambient occlusion). A subject counts as a room if much of
its middle is empty, these empty places are blocked in nearly all directions, and there
is content away from the outer walls. A solid object has no such empty places, and a
hollow object has no content inside.
"""

import itertools
import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from v3dg._numbers import Floats
from v3dg.bundle import Bundle
from v3dg.cameras import Axis, Camera, VectorLike
from v3dg.cleaning import examine
from v3dg.gaussians import Gaussians
from v3dg.rotations import rotation_from_quaternion
from v3dg.scene import Scene, Subject
from v3dg.upright import direction_of

DEFAULT_ELEVATION = math.radians(20)
"""Elevation of the first camera above the horizon, in radians, for an object."""

# Minimum and maximum number of gaussians that are examined. They suffice for a good
# view and can be read quickly.
_MOST_GAUSSIANS = 60_000
_MOST_INSTANCES = 15_000
# Number of views that determine the distance of a turntable. From that distance, each
# view shows the whole object.
_DISTANCE_VIEWS = 36
# Margin on each side of the picture, as a fraction of its size.
_MARGIN = 0.04
# Tangents of half the field of view, across the shorter side of the picture, and the
# maximum across the longer side. A wider field of view would look distorted.
_OUTSIDE_TANGENT = math.tan(math.radians(22.5))
_OUTSIDE_MOST = 1.0
_INSIDE_TANGENT = math.tan(math.radians(32.5))
_INSIDE_MOST = 1.2
_INSIDE_PITCH = math.radians(-8)

# A box grows in steps. These are the length of a step as a fraction of the box's side,
# the maximum number of steps, and the minimum weight of the gaussians in a step as a
# fraction of the total weight.
_STEP = 0.06
_MOST_STEPS = 100
_LEAST_WEIGHT = 2e-4

_VOXELS = 40  # number of voxels along each side of the grid
_DIRECTIONS = [step for step in itertools.product((-1, 0, 1), repeat=3) if any(step)]
# Limits that distinguish rooms from objects: the fraction of directions that must be
# blocked from a place in a room, the clearance of such a place, and the fraction of the
# middle that such places fill. They were measured on captured and generated rooms,
# towns, figures and rings.
_CLOSED = 0.75
_CLEARANCE = 0.1 * _VOXELS
_LEAST_FREE = 0.1
# A place may be open above. Then only directions count whose angle to the zenith has a
# smaller cosine than this.
_SKYWARD = 0.5
# Minimum fraction of the content that is away from the outer walls.
_LEAST_CONTENT = 0.02
_WALL_VOXELS = 3


class _Sample(NamedTuple):
    """A sample of the gaussians of a subject.

    Attributes:
        means: (N, 3) centres.
        first_axes, second_axes: (N, 3) the two longest semi-axes of each gaussian.
        weights: (N,) opacities, multiplied by the number of gaussians that each one
            represents.
    """

    means: Floats
    first_axes: Floats
    second_axes: Floats
    weights: Floats


class Surroundings(NamedTuple):
    """The places inside a subject.

    Attributes:
        places: (N, 3) free places that are closed on nearly all sides, possibly except
            above.
        outer_share: The fraction of what is seen from outside that is far from all
            closed places, such as a roof and a garden. It is 1 if the places are open
            above.
    """

    places: Floats
    outer_share: float


@dataclass(frozen=True)
class Framing:
    """The position and extent of a subject, which determine its first views.

    Attributes:
        center: (3,) centre of the box around nearly all gaussians, world units.
        radius: Half of the diagonal of that box, above 0.
        points: (P, 3) points that the first picture of an object must contain.
    """

    center: Floats
    radius: float
    points: Floats
    _places: "_Places | None" = None

    @property
    def is_inside(self) -> bool:
        """Whether the subject is a room, which is seen from inside."""
        return self._places is not None

    def camera(
        self,
        up: VectorLike,
        width: int,
        height: int,
        *,
        elevation: float = DEFAULT_ELEVATION,
        azimuth: float = 0.0,
    ) -> Camera:
        """Return the camera of the first view, for a picture of ``width`` x ``height``
        px. It shows the whole object, whatever the aspect ratio.

        Args:
            up: (3,) direction in the world.
            elevation: Angle of the camera above the horizon, in radians. Only used for
                an object.
            azimuth: Angle in radians by which the camera is moved around an object, or
                rotated inside a room.
        """
        axis = _unit(up)
        if self._places is not None:
            return self._inside(self._places, axis, (width, height), azimuth)
        forward = -_outwards(axis, elevation, azimuth)
        right_tangent, down_tangent = _tangents(
            width, height, _OUTSIDE_TANGENT, widest=_OUTSIDE_MOST
        )
        eye = _eye_that_sees(
            self.points,
            forward,
            axis,
            (1 - 2 * _MARGIN) * right_tangent,
            (1 - 2 * _MARGIN) * down_tangent,
        )
        distance = float((self.center - eye) @ forward)
        return Camera.look_at(
            eye,
            eye + distance * forward,
            axis,
            2 * math.atan(right_tangent),
            width=width,
            height=height,
        )

    def turntable(
        self,
        up: VectorLike,
        count: int,
        width: int,
        height: int,
        *,
        elevation: float = DEFAULT_ELEVATION,
    ) -> list[Camera]:
        """Return cameras that go around an object in a circle, each of which shows the
        whole object, or cameras that look around from inside a room. The distance does
        not depend on ``count``, so the first view is the same for any number of
        views."""
        axis = _unit(up)
        if self._places is not None:
            size = (width, height)
            return [self._inside(self._places, axis, size, a) for a in _azimuths(count)]
        right_tangent, down_tangent = _tangents(
            width, height, _OUTSIDE_TANGENT, widest=_OUTSIDE_MOST
        )
        offsets = self.points - self.center
        distance = 0.0
        for azimuth in _azimuths(_DISTANCE_VIEWS):
            forward = -_outwards(axis, elevation, azimuth)
            right, down = _across(forward, axis)
            needed = np.maximum(
                np.abs(offsets @ right) / right_tangent, np.abs(offsets @ down) / down_tangent
            )
            distance = max(distance, float((needed / (1 - 2 * _MARGIN) - offsets @ forward).max()))
        return [
            Camera.look_at(
                self.center + distance * _outwards(axis, elevation, azimuth),
                self.center,
                axis,
                2 * math.atan(right_tangent),
                width=width,
                height=height,
            )
            for azimuth in _azimuths(count)
        ]

    def focus(self, camera: Camera) -> Floats:
        """Return the (3,) point in front of a camera around which a viewer orbits."""
        forward = camera.viewmat[2, :3]
        if self._places is not None:
            return np.asarray(camera.position + 0.5 * self.radius * forward)
        distance = (self.center - camera.position) @ forward
        return np.asarray(camera.position + distance * forward)

    def _inside(
        self, places: "_Places", axis: Floats, size: tuple[int, int], azimuth: float
    ) -> Camera:
        """Return a camera in a room, at the place from which most is visible."""
        eye, best_azimuth = places.best(axis)
        forward = -_outwards(axis, -_INSIDE_PITCH, best_azimuth + azimuth)
        right_tangent, _ = _tangents(*size, _INSIDE_TANGENT, widest=_INSIDE_MOST)
        return Camera.look_at(
            eye,
            eye + 0.5 * self.radius * forward,
            axis,
            2 * math.atan(right_tangent),
            width=size[0],
            height=size[1],
        )


def _azimuths(count: int) -> list[float]:
    """Return evenly spaced angles in radians from 0 up to a full circle."""
    return [2 * math.pi * number / count for number in range(count)]


def frame_subject(subject: Subject) -> Framing:
    """Find the position and extent of a scene, a bundle or an asset, and whether it is
    a room.

    Only a coarse level of a bundle is read. A subject without gaussians is treated as a
    ball of radius 1 at the origin.
    """
    sample = _sample(subject)
    if not len(sample.means):
        corners = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
        return Framing(np.zeros(3), 1.0, corners)
    low, high = _box(sample.means, sample.weights)
    points = _outline(sample, low, high)
    center = (points.min(axis=0) + points.max(axis=0)) / 2
    radius = max(float(np.linalg.norm(np.ptp(points, axis=0))) / 2, 1e-6)
    return Framing(center, radius, points, _places(sample))


def surroundings(subject: Subject, up: Axis) -> Surroundings | None:
    """Return the places that a subject surrounds. In a room, they are the places
    inside. Otherwise they are places with a ground, a free sky and walls around, as in
    a street or a yard. Return None if there are none."""
    grid = _grid(_sample(subject))
    if grid is None:
        return None
    places = _free_places(grid, grid.distances, ~grid.is_solid)
    if len(places):
        return Surroundings(places, _outer_share(grid))
    zenith = np.array(direction_of(up))
    heights = np.array([zenith @ step / np.linalg.norm(step) for step in _DIRECTIONS])
    is_blocked = np.isfinite(grid.distances)
    has_ground = is_blocked[heights.argmin()] & ~is_blocked[heights.argmax()]
    places = _free_places(grid, grid.distances[heights < _SKYWARD], has_ground)
    if len(places):
        return Surroundings(places, 1.0)
    return None


def _sample(subject: Subject) -> _Sample:
    if isinstance(subject, Gaussians):
        host = subject.numpy()
        return _sample_of(host.subset(examine(host).drawable), _MOST_GAUSSIANS)
    scene = Scene.of(subject)
    parts = [_empty_sample()]
    stride = -(-len(scene) // _MOST_INSTANCES)
    most_rows = max(_MOST_GAUSSIANS // max(len(scene) // max(stride, 1), 1), 8)
    for number, bundle in enumerate(scene.bundles):
        instances = np.flatnonzero(scene.instance_bundle == number)[:: max(stride, 1)]
        if not len(instances) or not bundle.num_levels:
            continue
        local = _sample_of(_coarse_level(bundle), most_rows)
        parts.append(_placed(local, scene, instances))
    return _Sample(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def _empty_sample() -> _Sample:
    return _Sample(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))


def _coarse_level(bundle: Bundle) -> Gaussians:
    """Return the finest undamaged level that can be read quickly. If there is none,
    return the coarsest level.

    Damaged pages are not reported here, because drawing reports them.
    """
    levels = range(bundle.num_levels)
    for level in levels:
        clusters = bundle.level_range(level)
        offsets = bundle.clusters.offset
        if offsets[clusters.stop] - offsets[clusters.start] <= _MOST_GAUSSIANS:
            try:
                return bundle.level_gaussians(level)
            except ValueError:
                continue
    return bundle.level_gaussians(levels[-1])


def _sample_of(asset: Gaussians, most_rows: int) -> _Sample:
    """Return at most `most_rows` gaussians of an asset, evenly distributed over its
    rows."""
    count = min(most_rows, len(asset))
    rows = asset.numpy().subset(np.linspace(0, len(asset) - 1, count).astype(np.int64))
    scales = np.asarray(rows.scales, np.float64)
    order = np.argsort(-scales, axis=1)
    quats = np.asarray(rows.quats, np.float64)
    lengths = np.linalg.norm(quats, axis=1, keepdims=True)
    axes = rotation_from_quaternion(quats / np.where(lengths > 0, lengths, 1))
    half_axes = []
    for place in (0, 1):
        column = order[:, place, None]
        directions = np.take_along_axis(axes, column[:, None], axis=2)[..., 0]
        half_axes.append(directions * np.take_along_axis(scales, column, axis=1))
    return _Sample(
        np.asarray(rows.means, np.float64),
        half_axes[0],
        half_axes[1],
        np.asarray(rows.opacities, np.float64) * len(asset) / max(count, 1),
    )


def _placed(local: _Sample, scene: Scene, instances: npt.NDArray[np.int64]) -> _Sample:
    """Return the gaussians of a bundle at the poses of its instances."""
    linear = scene.rotations[instances] * scene.scales[instances, None, None]
    turned = [
        np.einsum("iab,kb->ika", linear, values).reshape(-1, 3)
        for values in (local.means, local.first_axes, local.second_axes)
    ]
    shift = np.repeat(scene.positions[instances], len(local.means), axis=0)
    weights = np.tile(local.weights, len(instances))
    return _Sample(turned[0] + shift, turned[1], turned[2], weights)


def _box(means: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Return the minimum and the maximum corner of a box around the gaussians, except
    for those far away from the others.

    The box begins as the middle 96 % along each axis. It grows in steps as long as the
    next step contains gaussians. Therefore it includes thin tips, but not a distant
    sky.
    """
    low, high = np.percentile(means, (2, 98), axis=0)
    longest = float((high - low).max())
    for axis in range(3):
        step = max(_STEP * (high[axis] - low[axis]), 1e-4 * longest, 1e-12)
        distances_below = (low[axis] - means[:, axis]) / step
        distances_above = (means[:, axis] - high[axis]) / step
        low[axis] -= step * _steps_with_gaussians(distances_below, weights)
        high[axis] += step * _steps_with_gaussians(distances_above, weights)
    return low, high


def _steps_with_gaussians(distances: Floats, weights: Floats) -> int:
    """Return the number of consecutive steps beyond a border that contain gaussians."""
    is_beyond = (distances > 0) & (distances <= _MOST_STEPS)
    numbers = np.ceil(distances[is_beyond]).astype(np.int64) - 1
    amounts = np.bincount(numbers, weights[is_beyond], _MOST_STEPS)
    is_empty = amounts <= _LEAST_WEIGHT * weights.sum()
    if not is_empty.any():
        return _MOST_STEPS
    return int(is_empty.argmax())


def _outline(sample: _Sample, low: Floats, high: Floats) -> Floats:
    """Return (P, 3) points that outline the gaussians in a box: centres, and ends of
    axes at two standard deviations."""
    is_inside = ((sample.means >= low) & (sample.means <= high)).all(axis=1)
    means = sample.means[is_inside]
    first = sample.first_axes[is_inside]
    second = sample.second_axes[is_inside]
    points = [means]
    for axes in (first, second):
        points += [means + 2 * axes, means - 2 * axes]
    usual_extent = float(np.median(np.linalg.norm(first, axis=1)))
    least = 1e-6 * max(float(np.abs(means).max()), 1e-20)
    border = max(0.02 * float((high - low).max()), 2 * usual_extent, least)
    return np.clip(np.concatenate(points), low - border, high + border)


def _unit(vector: VectorLike) -> Floats:
    values = np.asarray(vector, np.float64)
    scaled = values / np.abs(values).max()  # prevents overflow and underflow of squares
    return np.asarray(scaled / np.linalg.norm(scaled))


def _outwards(up: Floats, elevation: float, azimuth: float) -> Floats:
    """Return the (3,) unit vector from a subject to its camera.

    At azimuth 0, the camera is in front of the asset by the convention of viewers: on
    the side of -y if z is the vertical axis, and otherwise on the side of +z.
    """
    front = np.array([0.0, 0.0, 1.0])
    if int(np.abs(up).argmax()) == 2:
        front = np.array([0.0, -1.0, 0.0])
    front = front - up * (up @ front)
    front /= np.linalg.norm(front)
    aside = np.cross(up, front)
    level = math.cos(azimuth) * front + math.sin(azimuth) * aside
    return np.asarray(math.cos(elevation) * level + math.sin(elevation) * up)


def _tangents(width: int, height: int, shorter: float, *, widest: float) -> tuple[float, float]:
    """Return the tangents of half the horizontal and half the vertical field of
    view."""
    ratio = max(width, height) / min(width, height)
    longer = min(shorter * ratio, widest)
    if width >= height:
        return longer, longer / ratio
    return longer / ratio, longer


def _across(forward: Floats, up: Floats) -> tuple[Floats, Floats]:
    """Return the (3,) unit vectors that point right and down in a picture."""
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return right, np.cross(forward, right)


def _eye_that_sees(
    points: Floats, forward: Floats, up: Floats, right_tangent: float, down_tangent: float
) -> Floats:
    """Return the nearest eye (3,) whose frustum contains all points. The margins on the
    left and the right, or above and below, are equal."""
    right, down = _across(forward, up)
    depths = points @ forward
    place = np.zeros(3)
    nearest = math.inf
    for direction, tangent in ((right, right_tangent), (down, down_tangent)):
        across = points @ direction
        plus = float((across - tangent * depths).max())
        minus = float((-across - tangent * depths).max())
        place += (plus - minus) / 2 * direction
        nearest = min(nearest, -(plus + minus) / (2 * tangent))
    return place + nearest * forward


class _Grid(NamedTuple):
    """Voxels around most of the gaussians.

    Attributes:
        origin, side: Minimum corner of the grid, and side of a voxel, in world units.
        density: (V, V, V) optical density across a voxel.
        distances: (26, V, V, V) distance in voxels from each voxel to the next solid
            voxel in each direction, or infinity if there is none.
    """

    origin: Floats
    side: float
    density: Floats
    distances: npt.NDArray[np.float32]

    @property
    def is_solid(self) -> npt.NDArray[np.bool_]:
        return self.density > 0.5

    def center(self, voxels: npt.NDArray[np.intp]) -> Floats:
        """Return the centres (N, 3) of voxels (N, 3)."""
        return np.asarray(self.origin + self.side * (voxels + 0.5))


@dataclass(frozen=True, eq=False)
class _Places:
    """Places inside a room (N, 3), the gaussians (M, 3) that a view should show, and
    the size of the room."""

    places: Floats
    means: Floats
    weights: Floats
    size: float
    _best: dict[tuple[float, ...], tuple[Floats, float]] = field(default_factory=dict)

    def best(self, up: Floats) -> tuple[Floats, float]:
        """Return the place and the azimuth from which most is visible and nothing is
        close. The result is cached for each up vector."""
        key = tuple(up.tolist())
        if key not in self._best:
            self._best[key] = self._search(up)
        return self._best[key]

    def _search(self, up: Floats) -> tuple[Floats, float]:
        heights = self.places @ up
        low, high = np.quantile(self.means @ up, (0.02, 0.98))
        is_at_eye_height = np.abs((heights - low) / max(high - low, 1e-12) - 0.55) < 0.15
        places = self.places
        if is_at_eye_height.any():
            places = places[is_at_eye_height]
        places = places[:: -(-len(places) // 200)]
        best = (-math.inf, places[0], 0.0)
        for place in places:
            for azimuth, score in enumerate(self._scores(place, up)):
                if score > best[0]:
                    best = (float(score), place, 2 * math.pi * azimuth / _AZIMUTHS)
        return best[1], best[2]

    def _scores(self, place: Floats, up: Floats) -> Floats:
        """Return, for each azimuth, how much is visible from a place."""
        front = -_outwards(up, 0.0, 0.0)
        aside = np.cross(up, front)
        offsets = self.means - place
        distances = np.linalg.norm(offsets, axis=1) + 1e-12
        sines = offsets @ up / distances
        in_height = np.abs(np.arcsin(np.clip(sines, -1, 1)) - _INSIDE_PITCH) < 0.6
        azimuths = np.arctan2(offsets @ aside, offsets @ front)
        numbers = np.round(azimuths / (2 * math.pi) * _AZIMUTHS).astype(np.int64) % _AZIMUTHS
        # Near objects count negatively, because they hide others.
        weights = np.where(distances > 0.2 * self.size, 1.0, -4.0) * self.weights
        histogram = np.bincount(numbers[in_height], weights[in_height], _AZIMUTHS)
        reach = range(-_AZIMUTHS // 10, _AZIMUTHS // 10 + 1)
        return np.asarray(np.sum([np.roll(histogram, shift) for shift in reach], axis=0))


_AZIMUTHS = 36


def _places(sample: _Sample) -> _Places | None:
    """Return the places inside a subject if it is a room, and otherwise None."""
    grid = _grid(sample)
    if grid is None:
        return None
    places = _free_places(grid, grid.distances, ~grid.is_solid)
    if not len(places):
        return None
    size = grid.side * _VOXELS
    low = grid.origin
    is_inside = ((sample.means >= low) & (sample.means <= low + size)).all(axis=1)
    rows = np.flatnonzero(is_inside)[:: max(int(is_inside.sum()) // 5000, 1)]
    return _Places(places, sample.means[rows], sample.weights[rows], size)


def _outer_share(grid: _Grid) -> float:
    """Return the fraction of what is seen from outside that is farther than a wall from
    all voxels that are closed on nearly all sides."""
    is_blocked = np.isfinite(grid.distances)
    is_closed = ~grid.is_solid & (is_blocked.mean(axis=0) > _CLOSED)
    is_inner = _grown(is_closed, _WALL_VOXELS, includes_rim=False)
    visible = np.where(grid.is_solid & ~is_blocked.all(axis=0), grid.density, 0.0)
    return float(visible[~is_inner].sum() / max(visible.sum(), 1e-300))


def _free_places(
    grid: _Grid, distances: npt.NDArray[np.float32], is_possible: npt.NDArray[np.bool_]
) -> Floats:
    """Return the (N, 3) free places that are closed on nearly all sides. Return none if
    they fill too small a fraction of the middle, or if there is nothing between them.

    Args:
        distances: (D, V, V, V) the distances of the grid in the directions that count.
        is_possible: (V, V, V) whether a voxel may be such a place.
    """
    is_blocked = np.isfinite(distances)
    blocked = is_blocked.mean(axis=0)
    clearance = np.where(is_blocked, distances, _VOXELS).min(axis=0)
    is_solid = grid.is_solid
    is_place = is_possible & ~is_solid & (blocked > _CLOSED) & (clearance >= _CLEARANCE)
    places = np.argwhere(is_place)
    solid = np.argwhere(is_solid)
    if not len(places) or not len(solid):
        return np.zeros((0, 3))
    middle = np.prod(np.ptp(solid, axis=0) + 1) * 0.343
    is_open = ~is_solid & (blocked <= _CLOSED)
    near_outside = _grown(is_open, _WALL_VOXELS, includes_rim=True)
    weight = np.where(is_solid, grid.density, 0.0)
    content = weight[~near_outside].sum() / max(weight.sum(), 1e-12)
    if len(places) < _LEAST_FREE * middle or content < _LEAST_CONTENT:
        return np.zeros((0, 3))
    return grid.center(places)


def _grid(sample: _Sample) -> _Grid | None:
    """Return a grid of voxels around most of a sample. Return None if there are too few
    gaussians to enclose a place."""
    means = sample.means
    if len(means) < 200:
        return None
    median = np.median(means, axis=0)
    spread = 3.5 * float(np.median(np.abs(means - median), axis=0).max())
    low, high = np.percentile(means, (2, 98), axis=0)
    low = np.maximum(low, median - spread)
    high = np.minimum(high, median + spread)
    side = float((high - low).max()) / (_VOXELS - 2)
    if not side > 0:
        return None
    origin = (low + high) / 2 - side * _VOXELS / 2
    areas = np.linalg.norm(np.cross(sample.first_axes, sample.second_axes), axis=1)
    weights = sample.weights * 2 * math.pi * areas / (9 * side**2)
    density = np.zeros(_VOXELS**3)
    for first, second in itertools.product((-1, 0, 1), repeat=2):
        points = means + first * sample.first_axes + second * sample.second_axes
        voxels = np.floor(np.clip((points - origin) / side, -1, _VOXELS)).astype(np.int64)
        is_inside = ((voxels >= 0) & (voxels < _VOXELS)).all(axis=1)
        numbers = np.ravel_multi_index(tuple(voxels[is_inside].T), (_VOXELS,) * 3)
        density += np.bincount(numbers, weights[is_inside], _VOXELS**3)
    cube = density.reshape((_VOXELS,) * 3)
    return _Grid(origin, side, cube, _distances(cube > 0.5))


def _distances(is_solid: npt.NDArray[np.bool_]) -> npt.NDArray[np.float32]:
    """Return the distances (26, V, V, V), in voxels, to the next solid voxel in each
    direction."""
    distances = np.full((len(_DIRECTIONS), *is_solid.shape), np.inf, np.float32)
    for number, direction in enumerate(_DIRECTIONS):
        source = tuple(_shifted(step) for step in direction)
        target = tuple(_shifted(-step) for step in direction)
        current = distances[number]
        for _ in range(_VOXELS):
            following = np.full_like(current, np.inf)
            following[target] = np.where(is_solid[source], 1, current[source] + 1)
            if np.array_equal(following, current):
                break
            current = following
        distances[number] = current * np.linalg.norm(direction)
    return distances


def _shifted(step: int) -> slice:
    return slice(max(step, 0), _VOXELS + min(step, 0))


def _grown(mask: npt.NDArray[np.bool_], count: int, *, includes_rim: bool) -> npt.NDArray[np.bool_]:
    """Return a mask that is dilated by `count` voxels. `includes_rim` tells whether
    voxels outside the grid count as part of the mask."""
    grown = np.pad(mask, count, constant_values=includes_rim)
    for _ in range(count):
        wider = grown.copy()
        for axis in range(3):
            wider |= np.roll(grown, 1, axis) | np.roll(grown, -1, axis)
        grown = wider
    return grown[count:-count, count:-count, count:-count]
