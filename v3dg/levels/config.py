"""The settings of a build, with their ranges and defaults."""

import math
from dataclasses import dataclass, fields, replace
from typing import Annotated, Literal, NoReturn, get_args, get_origin

from v3dg._numbers import check, refuse
from v3dg.gaussians import TRAINED_FILTER_PX2

# Maximum side of a target picture, px. Drawing a picture cannot be interrupted, but
# takes less than about a second up to this size.
_MOST_SIDE = 8192
# Maximum number of samples along the side of a pixel in target pictures. More samples
# do not improve the fits.
_MOST_SAMPLES = 8
_DEEP = 64  # a level that is high enough to use `_MOST_SAMPLES`
# Maximum number of pixels in all views of a group together. Each thread that fits a
# group stores them, with 16 bytes each.
_MOST_PIXELS_KEPT = 1 << 26

# For each type of a setting, the Python types that are accepted, and the name of the
# type in error messages.
_KINDS: dict[type, tuple[tuple[type, ...], str]] = {
    int: ((int,), "a whole number"),
    float: ((int, float), "a number"),
    bool: ((bool,), "True or False"),
}
_Weight = Annotated[float, (0, 1_000_000)]
_StepSize = Annotated[float, (0, 1_000_000_000)]
_Setting = int | float | bool | str | None


@dataclass(frozen=True)
class BuildConfig:
    """The settings of a build. docs/levels.md explains the defaults; `paper()` returns
    the settings of V3DG.

    The annotation of each number has its smallest and largest value. Integers have 32
    bits in the core. Floats are stored as float32, so the ranges ensure that squares
    and products are finite, and that divisors are not 0.

    Attributes:
        cluster_size: Maximum number of gaussians in a cluster of level 0.
        group_size: Number of clusters that are simplified together, a power of two.
            With 2, the groups form a binary tree.
        min_clusters: Minimum number of clusters in a level. No levels with fewer are
            built.
        min_gaussians: Minimum number of gaussians in a level. No levels with fewer are
            built.
        init: How a coarser cluster is initialised. "merge" merges similar gaussians in
            pairs; "prune" removes the less important half.
        prune_growth: Factor for the scales of gaussians that survive pruning.
        targets: The level that a level is fitted to. "finest" is the lowest level whose
            detail is visible in the views; "previous" is the level below.
        steps: Maximum number of steps of Adam for each group; 0 keeps the initial
            gaussians.
        first_steps: Number of steps at level 1. It doubles with each level, up to
            `steps`.
        views_per_step: Number of views in one step.
        num_views: Number of views of a group. They are drawn once. 0 draws a new random
            view each time.
        supersample: The factor by which targets of level 1 are drawn larger, before
            they are averaged. It grows by one every two levels, up to 8, because the
            targets of higher levels have more detail per pixel. If `targets` is
            "previous", it does not grow.
        image_size: Side of the views, px. 0 shows a group at the size at which it is
            selected.
        px2_per_gaussian: The size at which views show a group, as the px² of its
            footprint divided by the number of gaussians that it is simplified to.
        distance: Distance from the camera to the centre of the group, in radii of the
            group.
        filter_px2: Variance, px², of the low-pass filter of the coarser levels. The
            last level has at least the variance of a pixel, 1/12, unless this setting
            is 0.
        smooth: Whether the asset is smooth: its gaussians are about as wide as the
            distances between them, so that one sample per pixel suffices in close
            views. Coarser levels of a smooth asset have no filter, except the last one,
            whose filter has the variance of a pixel. A group of level 1 is then
            selected at the sizes at which measured pictures of it look no worse than
            its leaves. With more than a million leaves, nothing is measured, and level
            1 is selected at half the size. "measured" finds out whether an asset is
            smooth, if levels are fitted with a filter: some groups of level 1 are
            fitted with a filter of 0.05 px² and without one. If the filter hardly
            improves them, the asset is smooth. If most of the asset is faint, coarser
            levels have no filter either, because it would reduce their alpha.
        asset_filter_px2: The filter of level 0. With None, it has the filter of the
            training if the asset is antialiased, and otherwise none. The filter that
            was used for training (0.3 for the original 3DGS) suits pictures of the size
            of the photographs; without a filter, the asset looks better from farther
            away. Coarser levels are always fitted to the asset without a filter.
        asset_antialiased: Whether the asset was trained with opacities that compensate
            for its filter. None uses the asset's own value (`Gaussians.antialiased`),
            or False if the asset has none.
        loss_l1, loss_dssim, loss_alpha: Weights of the parts of the loss.
        loss_cells: Weight of the L1 distances between means of cells of 4 x 4 px,
            relative to those between pixels. It counteracts a bias: a fit by pixels
            alone leads to medians, which are too low where the picture is faint or
            sparse.
        step_position: Step size of positions, in radii of the group, or in world units
            if `position_in_world` is true. `step_log_scale`, `step_quat`, `step_logit`,
            `step_sh0` and `step_sh_rest` are the step sizes of log scales, quaternions,
            opacity logits, and SH coefficients of degree 0 and of higher degrees.
        final_step: Ratio of the last step size to the first. Step sizes decay
            exponentially.
        beta2: Decay of Adam's running mean of squared gradients.

    Raises:
        ValueError: A setting has the wrong type or is out of range, or all views of a
            group together have too many pixels.
    """

    cluster_size: Annotated[int, (2, 1 << 30)] = 256
    group_size: Annotated[int, (2, 1 << 30)] = 2
    # Only Python code reads these counts, so they may exceed 32 bits. With the largest
    # values, the bundle has only level 0.
    min_clusters: Annotated[int, (1, 1 << 62)] = 1
    min_gaussians: Annotated[int, (1, 1 << 62)] = 1
    init: Literal["merge", "prune"] = "merge"
    # This is the growth per level.
    prune_growth: Annotated[float, (0.001, 1000)] = 2 ** (1 / 6)
    targets: Literal["finest", "previous"] = "finest"
    # With the maximum, a fit takes hours.
    steps: Annotated[int, (0, 1_000_000)] = 600
    first_steps: Annotated[int, (0, 1_000_000)] = 150
    # The maximum exists because a step cannot be interrupted.
    views_per_step: Annotated[int, (1, 1024)] = 2
    # There is a maximum because all views are drawn before the first step.
    num_views: Annotated[int, (0, 1 << 16)] = 64
    # Up to 64 x 64 samples are averaged in each pixel.
    supersample: Annotated[int, (1, 64)] = 3
    image_size: Annotated[int, (0, _MOST_SIDE)] = 0
    # With the maximum, a gaussian covers about 1000 x 1000 px.
    px2_per_gaussian: Annotated[float, (0.001, 1_000_000)] = 2.0
    # The minimum keeps the camera outside the ball. Beyond the maximum, the spacing of
    # float32 depths would exceed that of gaussians.
    distance: Annotated[float, (1.1, 1000)] = 4.0
    filter_px2: _Weight = 0.05
    smooth: Literal["measured", "yes", "no"] = "measured"
    asset_filter_px2: _Weight | None = None
    asset_antialiased: bool | None = None
    loss_l1: _Weight = 1.0
    loss_dssim: _Weight = 0.0
    loss_alpha: _Weight = 0.5
    loss_cells: _Weight = 1.0
    step_position: _StepSize = 0.0028
    position_in_world: bool = False
    step_log_scale: _StepSize = 0.032
    step_quat: _StepSize = 0.011
    step_logit: _StepSize = 0.04
    step_sh0: _StepSize = 0.032
    step_sh_rest: _StepSize = 0.008
    final_step: Annotated[float, (1e-6, 1_000_000)] = 0.1
    beta2: Annotated[float, (0, 0.999999)] = 0.99

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            kind = field.type
            if type(None) in get_args(kind):
                if value is None:
                    continue
                kind = get_args(kind)[0]
            arguments = get_args(kind)
            if get_origin(kind) is Literal:
                if value not in arguments:
                    self._refuse(field.name, " or ".join(map(repr, arguments)))
                continue
            kind, *ranges = arguments or (kind,)
            classes, expected = _KINDS[kind]
            is_kind = isinstance(value, classes) and isinstance(value, bool) == (kind is bool)
            if not is_kind:
                self._refuse(field.name, expected)
            for minimum, maximum in ranges:
                if not minimum <= value <= maximum:
                    self._refuse(field.name, f"{minimum:,} to {maximum:,}")
        if self.group_size.bit_count() != 1:
            self._refuse("group_size", "a power of two")
        self.check_views(1)

    def _refuse(self, name: str, expected: str) -> NoReturn:
        refuse(name, f"{expected}, got {getattr(self, name)!r}")

    def check_views(self, most_gaussians: int) -> None:
        """Raise ValueError if views of groups of at most `most_gaussians` have too many
        pixels."""
        if self.image_size > 0:
            name = "image_size"
            side = self.image_size
        else:
            name = "px2_per_gaussian"
            side = self._view_side(most_gaussians)
        fits = (
            side * self.samples_at(_DEEP) <= _MOST_SIDE
            and side**2 * self.num_views <= _MOST_PIXELS_KEPT
        )
        check(
            name,
            fits,
            f"views of at most {_MOST_SIDE} px a side after multiplication by `supersample`, and "
            f"at most {_MOST_PIXELS_KEPT} px in all `num_views` together, got views of {side} px "
            f"a side; reduce `supersample`, `num_views`, `{name}` or `cluster_size`",
        )

    def _view_side(self, num_gaussians: int) -> int:
        """Return the side, px, of a view of a group of `num_gaussians`. The core's
        fit_view() chooses the same side."""
        x2 = self.distance**-2
        footprint_of_focal = 2 * math.pi * (1 - math.sqrt(1 - x2))
        radius2 = num_gaussians * self.px2_per_gaussian / footprint_of_focal * x2 / (1 - x2)
        return math.ceil(2 * math.sqrt(radius2)) + 8

    def steps_at(self, level: int) -> int:
        """Return the number of steps for the groups of a level."""
        return min(self.steps, self.first_steps << min(max(level - 1, 0), 32))

    def samples_at(self, level: int) -> int:
        """Return the number of samples along the side of a pixel in the target pictures
        of a level."""
        if self.targets == "previous":
            return self.supersample
        return max(self.supersample, min(self.supersample + (level - 1) // 2, _MOST_SAMPLES))

    def target_of(self, level: int) -> int:
        """Return the level that the groups of a level are fitted to.

        A level with more than two gaussians per sample of a target picture shows no
        additional detail, so it is not used.
        """
        if self.targets == "previous":
            return max(0, level - 1)
        return max(0, level - self._visible_levels)

    def levels_at_once(self, first: int, end: int) -> range:
        """Return the levels before `end` that are fitted together with level `first`.

        The lowest levels are drawn most often, so each of them starts from the fitted
        level below. The levels above have few groups, so fitting them one after another
        would take long. They are initialised together, by repeated merging of the last
        fitted level.
        """
        end = min(end, first + self._visible_levels)
        stop = first + 1
        if self.target_of(first) > 0 and self.targets == "finest":
            while stop < end and self.steps_at(stop) == self.steps_at(first):
                stop += 1
        return range(first, stop)

    @property
    def _visible_levels(self) -> int:
        """The number of lower levels whose detail the target pictures of a level show.
        Gaussians smaller than about half a sample are not visible."""
        px2 = self.px2_per_gaussian
        if self.image_size > 0:  # the ball covers about 0.4 of the picture
            px2 = 0.4 * self.image_size**2 / (self.cluster_size * self.group_size / 2)
        return 1 + max(1, math.ceil(math.log2(px2 * self.supersample**2)))

    def of_asset(self, *, antialiased: bool | None) -> "BuildConfig":
        """Return these settings with the filter of the asset. `antialiased` is the
        asset's own declaration, or None if there is none."""
        if self.asset_antialiased is not None:
            antialiased = self.asset_antialiased
        filter_px2 = self.asset_filter_px2
        if filter_px2 is None:
            filter_px2 = 0.0
            if antialiased:
                filter_px2 = TRAINED_FILTER_PX2
        return replace(self, asset_antialiased=bool(antialiased), asset_filter_px2=filter_px2)

    def contradiction(self, *, antialiased: bool | None) -> str:
        """Describe how these settings contradict the asset's own declaration. Return an
        empty text if they agree."""
        setting = self.asset_antialiased
        if setting is None or antialiased is None or setting == antialiased:
            return ""
        if antialiased:
            return (
                "declared as trained with antialiasing, but built with asset_antialiased=False; "
                "omit that setting to use the declaration"
            )
        return (
            "declared as trained without antialiasing, but built with asset_antialiased=True; "
            "omit that setting to use the declaration"
        )

    @property
    def asset_look(self) -> tuple[float, bool]:
        """The variance of the filter of level 0, px², and whether the opacities
        compensate for that filter."""
        config = self.of_asset(antialiased=None)
        return config.asset_filter_px2 or 0.0, bool(config.asset_antialiased)

    @staticmethod
    def leaves_only() -> "BuildConfig":
        """Return settings with which a bundle has only level 0."""
        return BuildConfig(min_clusters=1 << 31)

    @staticmethod
    def paper(**changes: _Setting) -> "BuildConfig":
        """Return the settings of the paper and its code (V3DG, sections 3.2 and 5.1),
        with `changes` to them.

        There are 4,096 gaussians per cluster and two clusters per group, and levels end
        at two clusters. Gaussians are pruned, and scales grow by 2^(1/6). Fits use 640
        new random views of 64 x 64 px from a distance of four radii, compared with the
        previous level without a filter. The loss is 0.8 L1 + 0.2 D-SSIM + 0.1 alpha.
        """
        config = BuildConfig(
            cluster_size=4096,
            group_size=2,
            min_clusters=2,
            init="prune",
            targets="previous",
            steps=640,
            first_steps=640,
            views_per_step=1,
            num_views=0,
            supersample=1,
            image_size=64,
            filter_px2=0.0,
            smooth="no",
            loss_l1=0.8,
            loss_dssim=0.2,
            loss_alpha=0.1,
            loss_cells=0.0,
            step_position=1.6e-5,
            position_in_world=True,
            step_log_scale=5e-3,
            step_quat=1e-3,
            step_logit=5e-2,
            step_sh0=2.5e-3,
            step_sh_rest=2.5e-3 / 20,
            final_step=1.0,
            beta2=0.999,
        )
        return replace(config, **changes)  # type: ignore[arg-type]  # the constructor checks types
