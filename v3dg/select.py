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

# px² of screen per gaussian of a coarser cluster; docs/levels.md has the resulting
# error.
DEFAULT_TOLERANCE = 3.0

# The fade for sequences of pictures; docs/fades.md has its cost and benefit.
DEFAULT_FADE = 1.02
_FADE_PX2 = np.float32(_core.fade_filter_px2)


@dataclass(frozen=True, eq=False)
class Selection:
    """The clusters that one view needs, in ascending order of instance, then cluster.

    Attributes:
        scene: The scene of the selection. It may have moved or grown since. After
            instances were removed, the cut is invalid, and drawing it raises
            ValueError.
        instance_ids: (S,) int32, read-only.
        cluster_ids: (S,) int32, indices in the instance's bundle, read-only.
        num_gaussians: Number of gaussians in all selected clusters.
        tolerance: The tolerance in px²; with a budget, the one that meets it.
        seconds: Wall time of the selection.
        revision: Revision of the scene at the selection; the current one if None.
        given_weights: Like `weights`, read-only; None without a fade, when all are 1.
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
        expected = f"{len(self)} numbers of 0 to 1"
        check("given_weights", len(weights) == len(self), f"{expected}, got {len(weights)}")
        check("given_weights", ((weights >= 0) & (weights <= 1)).all(), f"{expected}, got others")
        for values in (self.instance_ids, self.cluster_ids, weights):
            values.flags.writeable = False

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return Selection, tuple(getattr(self, field.name) for field in fields(self))

    def check(self, revision: tuple[int, int, int]) -> None:
        """Raise ValueError unless a scene of this revision still has the instances of
        the cut."""
        assert self.revision is not None
        if revision[2] != self.revision[2]:
            problem = "instances were removed from the scene after this selection"
            raise ValueError(f"cut: {problem}; select again")

    def __len__(self) -> int:
        return len(self.instance_ids)

    def gaussians(
        self, origin: VectorLike = (0.0, 0.0, 0.0), *, device: str | Device = "auto"
    ) -> Gaussians:
        """Return the selected gaussians in the world, N in the order of the selection,
        for any rasterizer.

        Spherical harmonics are rotated into the world and multiplied by the tints of
        the instances, which is exact. The SH degree is the highest of the bundles in
        the selection. Opacities are multiplied by the weights of their clusters, so
        that fades work in every rasterizer, and by the opacities of their instances.

        Args:
            origin: (3,) point in the world that means are relative to. Use the camera's
                position if the scene is so far from zero that float32 is not precise
                enough.
            device: ``"cpu"`` returns NumPy arrays, ``"cuda"`` torch tensors there,
                ``"auto"`` the latter if CUDA works. Both have the same values.
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
        """(S,) weights in [0, 1] that the clusters are drawn with."""
        if self.given_weights is None:
            return np.ones(len(self), np.float32)
        return self.given_weights

    @property
    def filters_px2(self) -> npt.NDArray[np.float32]:
        """(N,) variance of the screen-space filter of each gaussian.

        In a fade, a level 0 without a filter is drawn with 0.05 px² and as
        `antialiased`. `render` limits this filter to four times a gaussian's own
        variance, so that many tiny gaussians stay opaque.
        """

        def filter_px2(clusters: Clusters) -> npt.NDArray[np.float32]:
            has_fade_filter = self._has_only_fade_filter(clusters)
            return np.where(has_fade_filter, _FADE_PX2, clusters.filter_px2).astype(np.float32)

        return self._per_gaussian(filter_px2, np.float32)

    @property
    def antialiased(self) -> npt.NDArray[np.bool_]:
        """(N,) whether each gaussian's opacity is compensated for its filter."""

        def antialiased(clusters: Clusters) -> npt.NDArray[np.bool_]:
            return self._has_only_fade_filter(clusters) | (clusters.antialiased > 0)

        return self._per_gaussian(antialiased, np.bool_)

    def _has_only_fade_filter(self, clusters: Clusters) -> npt.NDArray[np.bool_]:
        """Return (C,) whether the fade gives the clusters a filter, because they have
        none."""
        fades = self.given_weights is not None
        return np.asarray((clusters.level == 0) & (clusters.filter_px2 == 0) & fades)

    def _first(self) -> npt.NDArray[np.int64]:
        """Return (S + 1,) the first gaussian of each selected cluster, then their total
        number."""
        return np.concatenate(
            [[0], np.cumsum(self.per_pair(lambda clusters: np.diff(clusters.offset)))]
        )

    def per_pair(self, column: Callable[[Clusters], npt.NDArray[_Value]]) -> npt.NDArray[_Value]:
        """Return (S,) values of the selected clusters from a column (C,) of the tables
        of their bundles."""
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
        # The dtype is explicit, because a scene without bundles has no column.
        return np.repeat(self.per_pair(column).astype(dtype), np.diff(self._first()))


class CutOptions(TypedDict, total=False):
    """The options that determine the cut of a view."""

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
    Clusters outside the frustum are then left out. Rotating the camera, or moving it
    together with the scene, changes only what is left out.

    Args:
        subject: A scene or a bundle, or its file, which every call opens again.
        camera: Its model may be any, but the paper's footprint needs a pinhole. For a
            stereo camera, the cut is detailed enough for the nearer eye and includes
            everything that either eye may see; this excludes the paper's footprint.
        tolerance: Screen area in px² per gaussian of a coarser cluster. 0 chooses full
            detail wherever it covers any area, infinity the coarsest clusters. None
            means `DEFAULT_TOLERANCE`, or 0 with a budget.
        budget: Largest number of gaussians of one view. The tolerance is raised, by the
            same factor for all instances, to the smallest of 2,048 values per octave
            from which on no cut has more.
        min_level: No cluster of a finer level is chosen, unless an asset has no coarser
            one.
        footprint: ``"solid_angle"``, or ``"paper"`` for the published formula, with
            which several clusters on a path may be chosen.
        cull: False keeps clusters outside the frustum.
        fade: Clusters within this factor of the tolerance are drawn on two or more
            levels, with weights that add up to exactly 1 on every path and depend only
            on the view. One level fades in while the other fades out, so that nothing
            pops as the camera moves. A level 0 without its own filter is drawn with a
            low-pass filter of 0.05 px², so that it does not flicker. `DEFAULT_FADE` is
            meant for sequences of pictures; 1 and None choose one cluster on every
            path. It excludes the paper's footprint.
        device: The device that selects: ``"cpu"``, ``"cuda"``, or ``"auto"``, which is
            CUDA if it can be used. All give the same cut.

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
    """Select for one view; with `steps`, the state of a budget, for the next view of a
    sequence."""
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
    """Return the rule of a selection for the core; raise ValueError for a number that
    `select` does not accept."""
    if tolerance is None:
        tolerance = 0.0
        if budget is None:
            tolerance = DEFAULT_TOLERANCE
    tolerance = real(tolerance, "tolerance", "0 px² or more", 0)
    if tolerance != np.inf:
        tolerance = min(tolerance, MOST_FLOAT)
    if budget is not None:
        budget = whole(budget, "budget", "a whole number of gaussians, 0 or more", 0, (1 << 63) - 1)
    one_of(footprint, "footprint", get_args(Footprint))
    factor = 1.0
    if fade is not None:
        factor = real(fade, "fade", "None or a factor of 1 to 1000", 1, 1000)
    if factor != 1 and footprint == "paper":
        refuse(
            "fade",
            f"None with the paper's footprint, which can decrease towards the root, got {factor:g}",
        )
    return _core.Rule(
        tolerance_px2=tolerance,
        budget=budget,
        min_level=whole(min_level, "min_level", "a level, 0 or more", 0),
        footprint=footprint,
        culls=bool(cull),
        fade=factor,
    )


def over_budget(budget: int, least: int) -> ValueError:
    """Return the error for a budget that the coarsest cut exceeds; ``least`` is the
    size of that cut."""
    expected = f"at least {least} gaussians, which the coarsest cut of this view has"
    return ValueError(f"budget: expected {expected}, got {budget}")
