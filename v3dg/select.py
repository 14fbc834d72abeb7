"""Selection: the clusters of a scene that one view needs."""

from __future__ import annotations

import copy
import time
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Literal, TypeAlias, TypedDict, TypeVar, get_args, overload

import numpy as np
import numpy.typing as npt

from v3dg import _core, _device
from v3dg._device import Device
from v3dg._numbers import MOST_FLOAT, check, one_of, real, refuse, vector, whole
from v3dg.bundle import Bundle, Clusters
from v3dg.cameras import Camera, StereoCamera, VectorLike, check_camera, for_each
from v3dg.gaussians import Gaussians
from v3dg.opening import File, opened
from v3dg.residency import residency
from v3dg.scene import Scene

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from typing_extensions import Unpack

_Value = TypeVar("_Value", bound=np.generic)
Footprint: TypeAlias = Literal["solid_angle", "paper"]

# The default tolerance: px² on screen per gaussian of a coarser cluster. docs/levels.md
# lists the errors.
DEFAULT_TOLERANCE = 3.0

# The recommended fade for sequences of pictures. docs/fades.md describes its cost and
# benefit.
DEFAULT_FADE = 1.02
_FADE_PX2 = np.float32(_core.fade_filter_px2)


@dataclass(frozen=True, eq=False)
class Selection:
    """The clusters that one view needs, in ascending order of instance, then cluster.

    Attributes:
        scene: The scene of the selection. Instances may be moved and added afterwards.
            If instances are removed, the cut becomes invalid, and drawing it raises
            ValueError.
        instance_ids: (S,) int32 indices of instances, read-only.
        cluster_ids: (S,) int32 indices of clusters in the instance's bundle, read-only.
        num_gaussians: Number of gaussians in all selected clusters.
        tolerance: The tolerance in px² per gaussian. With a budget, it is the tolerance
            that meets the budget.
        seconds: Wall-clock time of the selection.
        revision: Revision of the scene at the time of the selection; None means the
            current revision.
        given_weights: (S,) weights with which the clusters are drawn, read-only.
            Without a fade, it is None, which means that all weights are 1.
    """

    scene: Scene
    instance_ids: npt.NDArray[np.int32]
    cluster_ids: npt.NDArray[np.int32]
    num_gaussians: int
    tolerance: float
    seconds: float
    revision: tuple[int, int, int] | None = None
    given_weights: npt.NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        if self.revision is None:
            object.__setattr__(self, "revision", self.scene.revision)
        if self.given_weights is not None:
            numbers = np.asarray(self.given_weights)
            if numbers.dtype.kind not in "biuf":
                numbers = np.full(numbers.shape, np.nan)  # the check below rejects NaN
            object.__setattr__(self, "given_weights", np.ascontiguousarray(numbers, np.float32))
        weights = self.weights
        expected = f"{len(self)} numbers from 0 to 1"
        check("given_weights", len(weights) == len(self), f"{expected}, got {len(weights)}")
        is_wrong = ~((weights >= 0) & (weights <= 1))
        check("given_weights", not is_wrong.any(), f"{expected}, got {weights[is_wrong][:1]}")
        for values in (self.instance_ids, self.cluster_ids, weights):
            values.flags.writeable = False

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return Selection, tuple(getattr(self, field.name) for field in fields(self))

    def check(self, revision: tuple[int, int, int]) -> None:
        """Raise ValueError if instances were removed from the scene between the
        selection and this revision."""
        assert self.revision is not None
        if revision[2] != self.revision[2]:
            problem = "instances were removed from the scene after this selection"
            raise ValueError(f"cut: {problem}; select again")

    def __len__(self) -> int:
        return len(self.instance_ids)

    def gaussians(
        self, origin: VectorLike = (0.0, 0.0, 0.0), *, device: str | Device = "auto"
    ) -> Gaussians:
        """Return the N selected gaussians in world space, in the order of the
        selection, for any rasterizer.

        Spherical harmonics are rotated and multiplied by the tints of the instances,
        which is exact. The SH degree is the highest of the bundles in the selection.
        Opacities are multiplied by the weights of their clusters, so that fades work in
        every rasterizer, and by the opacities of their instances.

        Args:
            origin: (3,) point in the world that is subtracted from all means. Use the
                camera's position if coordinates are too large for the precision of
                float32.
            device: ``"cpu"`` returns NumPy arrays, ``"cuda"`` returns CUDA tensors, and
                ``"auto"`` returns CUDA tensors if CUDA can be used, else NumPy arrays.
                The values are the same.
        """
        target = _device.resolve(device)
        shift = vector(origin, "origin")
        scene = copy.copy(self.scene)  # other threads may change the original meanwhile
        ids, instance = np.unique(self.instance_ids, return_inverse=True)
        bundle_ids, bundle = np.unique(scene.instance_bundle[ids], return_inverse=True)
        factors = scene.factors
        if factors is not None:
            factors = factors[ids]
        rows = []
        first_row = np.empty(len(self), np.int64)
        self.check(scene.revision)
        with target.current():
            for number, bundle_id in enumerate(bundle_ids):
                is_in_bundle = bundle[instance] == number
                cluster_ids = self.cluster_ids[is_in_bundle]
                bundle_rows, first_rows = residency.rows(
                    scene.bundles[bundle_id], cluster_ids, target
                )
                first_row[is_in_bundle] = first_rows
                rows.append(bundle_rows)
            world = _core.gather(
                bundles=rows,
                instances=_core.Instances(
                    bundle=bundle.astype(np.int32),
                    positions=scene.positions[ids] - shift,
                    quaternions=scene.quaternions[ids],
                    scales=scene.scales[ids],
                    importance=scene.importance[ids],
                    factors=factors,
                ),
                instance=instance.astype(np.int32),
                first_row=first_row,
                offset=self._first(),
                weights=self.given_weights,
                device=target.number,
            )
        return Gaussians(*world)

    @property
    def weights(self) -> npt.NDArray[np.float32]:
        """(S,) weights in [0, 1] with which the clusters are drawn."""
        if self.given_weights is None:
            return np.ones(len(self), np.float32)
        return self.given_weights

    @property
    def filters_px2(self) -> npt.NDArray[np.float32]:
        """(N,) variance of the screen-space filter of each gaussian.

        With a fade, a level 0 without a filter is drawn with a filter of 0.05 px² and
        with compensated opacities. `render` limits this filter to four times the
        variance of a gaussian, so that many tiny gaussians stay opaque.
        """

        def filter_px2(clusters: Clusters) -> npt.NDArray[np.float32]:
            has_fade_filter = self._has_only_fade_filter(clusters)
            return np.where(has_fade_filter, _FADE_PX2, clusters.filter_px2).astype(np.float32)

        return self._per_gaussian(filter_px2, np.float32)

    @property
    def antialiased(self) -> npt.NDArray[np.bool_]:
        """(N,) whether the opacity of each gaussian is compensated for its filter."""

        def antialiased(clusters: Clusters) -> npt.NDArray[np.bool_]:
            return self._has_only_fade_filter(clusters) | (clusters.antialiased > 0)

        return self._per_gaussian(antialiased, np.bool_)

    def _has_only_fade_filter(self, clusters: Clusters) -> npt.NDArray[np.bool_]:
        """Return (C,) whether a cluster has no filter of its own, but gets one from the
        fade."""
        fades = self.given_weights is not None
        return np.asarray((clusters.level == 0) & (clusters.filter_px2 == 0) & fades)

    def _first(self) -> npt.NDArray[np.int64]:
        """Return (S + 1,) the index of the first gaussian of each selected cluster,
        then the total number of gaussians."""
        return np.concatenate(
            [[0], np.cumsum(self.per_pair(lambda clusters: np.diff(clusters.offset)))]
        )

    def per_pair(self, column: Callable[[Clusters], npt.NDArray[_Value]]) -> npt.NDArray[_Value]:
        """Return (S,) the values of the selected clusters. The function returns a
        column (C,) of the tables of a bundle."""
        scene = copy.copy(self.scene)
        self.check(scene.revision)
        columns = [column(bundle.clusters) for bundle in scene.bundles]
        values = np.zeros(len(self), np.result_type(np.bool_, *columns))
        bundle_from_pair = scene.instance_bundle[self.instance_ids]
        for number, table in enumerate(columns):
            is_in_bundle = bundle_from_pair == number
            values[is_in_bundle] = table[self.cluster_ids[is_in_bundle]]
        return values

    def _per_gaussian(
        self, column: Callable[[Clusters], npt.NDArray[_Value]], dtype: type[_Value]
    ) -> npt.NDArray[_Value]:
        # The dtype must be passed, because a scene without bundles has no column with a
        # dtype.
        return np.repeat(self.per_pair(column).astype(dtype), np.diff(self._first()))


class CutOptions(TypedDict, total=False):
    """Arguments that determine the cut of a view."""

    tolerance: float | None
    budget: int | None
    min_level: int
    fade: float | None


class _Options(CutOptions, total=False):
    device: str | Device
    footprint: Footprint
    cull: bool


@overload
def select(
    subject: Scene | Bundle | File, camera: Camera | StereoCamera, **options: Unpack[_Options]
) -> Selection: ...
@overload
def select(
    subject: Scene | Bundle | File, camera: Sequence[Camera], **options: Unpack[_Options]
) -> list[Selection]: ...
def select(
    subject: Scene | Bundle | File,
    camera: Camera | StereoCamera | Sequence[Camera],
    *,
    tolerance: float | None = None,
    budget: int | None = None,
    min_level: int = 0,
    footprint: Footprint = "solid_angle",
    cull: bool = True,
    fade: float | None = None,
    device: str | Device = "auto",
) -> Selection | list[Selection]:
    """Choose the clusters that are just detailed enough for one view, or for each of
    several.

    Exactly one cluster is chosen on every path from a leaf of an instance to its root.
    Chosen clusters outside the frustum are then left out. Rotating the camera, or
    moving camera and scene together, changes only which clusters are left out.

    Args:
        subject: A scene or a bundle; or the path of its file, which is opened in every
            call.
        camera: Camera of any model. For a stereo camera, the cut is detailed enough for
            the nearer eye, and includes everything that either eye may see. Stereo and
            distorted cameras cannot be combined with the paper's footprint.
        tolerance: Largest screen area, in px² per gaussian, at which a coarser cluster
            replaces finer ones. 0 chooses full detail wherever it covers any area, and
            infinity chooses the coarsest clusters. None means `DEFAULT_TOLERANCE`, or 0
            with a budget.
        budget: Largest number of gaussians of one view. If the cut has more, the
            tolerance is raised, by the same factor for all instances, to the smallest
            value from which on no cut exceeds the budget. 2,048 values per octave are
            considered.
        min_level: Clusters of levels below this one are not chosen, except from bundles
            with fewer levels.
        footprint: ``"solid_angle"``, or ``"paper"`` for the published formula, which
            may choose several clusters on a path.
        cull: Whether to leave out clusters outside the frustum.
        fade: Clusters within this factor of the tolerance are drawn on two or more
            levels, with weights that add up to exactly 1 on every path and only depend
            on the view. One level fades in while the other fades out, so that nothing
            pops as the camera moves. If level 0 has no filter, it is drawn with a
            low-pass filter of 0.05 px², so that it does not flicker. `DEFAULT_FADE` is
            meant for sequences of pictures. 1 and None choose one cluster on every
            path. A fade cannot be combined with the paper's footprint.
        device: The device that selects: ``"cpu"``, ``"cuda"``, or ``"auto"``, which
            means CUDA if it can be used. All devices choose the same cut.

    Raises:
        ValueError: The coarsest cut has more gaussians than the budget, ``tolerance``
            is negative or not a number, or another argument is invalid.
        RuntimeError: ``device`` is ``"cuda"`` and cannot be used.

    Source: Yang et al., Virtualized 3D Gaussians, SIGGRAPH 2025, online selection; the
    budget is ours.
    """
    rule = rule_of(tolerance, budget, min_level, footprint, cull=cull, fade=fade)
    target = _device.resolve(device)
    scene = opened(subject)
    return for_each(camera, lambda view: select_by(rule, scene, view, budget, target))


def select_by(
    rule: _core.Rule,
    subject: Scene | Bundle,
    camera: Camera | StereoCamera,
    budget: int | None,
    device: Device,
    steps: _core.BudgetSteps | None = None,
) -> Selection:
    """Select the cut of one view. `steps` is the state of a budget in a sequence of
    views, or None for a single view."""
    check_camera(camera)
    start = time.perf_counter()
    with residency.turn(device):
        resident = residency.scene(subject, device)
        cut = resident.core.select(camera.core, rule, steps)
    if not cut.fits_budget:
        assert budget is not None
        raise over_budget(budget, cut.num_gaussians)
    seconds = time.perf_counter() - start
    weights = None
    if len(cut.weights):
        weights = cut.weights
    return Selection(
        scene=Scene.of(subject),
        instance_ids=cut.instance_ids,
        cluster_ids=cut.cluster_ids,
        num_gaussians=cut.num_gaussians,
        tolerance=cut.tolerance_px2,
        seconds=seconds,
        revision=resident.revision,
        given_weights=weights,
    )


def rule_of(
    tolerance: float | None,
    budget: int | None,
    min_level: int,
    footprint: Footprint = "solid_angle",
    *,
    cull: bool = True,
    fade: float | None = None,
) -> _core.Rule:
    """Return the rule of a selection for the core. Raise ValueError for a value that
    `select` does not accept."""
    if tolerance is None:
        tolerance = 0.0
        if budget is None:
            tolerance = DEFAULT_TOLERANCE
    tolerance = real(tolerance, "tolerance", "a number of px² of at least 0", 0)
    if tolerance != np.inf:
        tolerance = min(tolerance, MOST_FLOAT)
    if budget is not None:
        budget = whole(
            budget, "budget", "a whole number of gaussians of at least 0", 0, (1 << 63) - 1
        )
    one_of(footprint, "footprint", get_args(Footprint))
    factor = 1.0
    if fade is not None:
        factor = real(fade, "fade", "None or a factor from 1 to 1000", 1, 1000)
    if factor != 1 and footprint == "paper":
        refuse(
            "fade",
            f"None with the paper's footprint, which can decrease towards the root, got {factor:g}",
        )
    return _core.Rule(
        tolerance_px2=tolerance,
        budget=budget,
        min_level=whole(min_level, "min_level", "the index of a level, at least 0", 0),
        footprint=footprint,
        culls=bool(cull),
        fade=factor,
    )


def over_budget(budget: int, least: int) -> ValueError:
    """Return the error for a budget that is smaller than the coarsest cut. ``least`` is
    the number of gaussians in that cut."""
    expected = f"at least {least}, the number of gaussians in the coarsest cut of this view"
    return ValueError(f"budget: expected {expected}, got {budget}")
