"""The settings of a build, with their ranges and defaults."""

import math
from dataclasses import dataclass, fields, replace
from typing import Annotated, Literal, NoReturn, get_args, get_origin

from v3dg._numbers import check, refuse
from v3dg.gaussians import TRAINED_FILTER_PX2

# Maximum side of a target picture, px. Drawing one cannot be interrupted; up to this
# size it takes less than about a second.
_MOST_SIDE = 8192
# Maximum number of samples along the side of a pixel in target pictures; more do not
# improve the fits.
_MOST_SAMPLES = 8
_DEEP = 64  # a level deep enough to use `_MOST_SAMPLES`
# Limit on the pixels of all views of a group together. Each thread that fits a group
# stores them, 16 bytes each.
_MOST_PIXELS_KEPT = 1 << 26

# For each type of a setting: the Python types that are accepted, and what error
# messages call them.
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

    The type of each number is annotated with its smallest and largest value. Integers
    have 32 bits in the core. The others are float32: squares and products of them must
    be finite, and divisors must not be 0.

    Attributes:
        cluster_size: Maximum number of gaussians in a cluster of level 0.
        group_size: Number of clusters that are simplified together, a power of two.
            With 2, the groups form a binary tree.
        min_clusters: Minimum number of clusters in a level; coarser levels are not
            built.
        min_gaussians: Minimum number of gaussians in a level; coarser levels are not
            built.
        init: How a coarser cluster is initialised: "merge" similar gaussians in pairs,
            or "prune" the less important half.
        prune_growth: Factor for the scales of gaussians that survive pruning.
        targets: The level whose pictures a level is fitted to: the "finest" level below
            whose detail is visible in its views, or the "previous" one.
        steps: Maximum number of steps of Adam for each group; 0 keeps the initial
            gaussians.
        first_steps: Steps at level 1; each level has twice as many as the one below, up
            to `steps`.
        views_per_step: Number of views in one step.
        num_views: Number of views of a group, drawn once; 0 draws a new random view
            each time.
        supersample: The factor by which targets of level 1 are drawn larger before box
            averaging. It grows by one every two levels, up to 8, because higher levels
            show finer gaussians. With targets of the previous level it does not grow.
        image_size: Side of the views in px; 0 shows a group at the size at which it is
            selected.
        px2_per_gaussian: The size at which views show a group: px² of its footprint for
            each gaussian that it is simplified to.
        distance: Distance from the camera to the centre of the group, in radii of the
            group.
        filter_px2: Variance, px², of the low-pass filter of the coarser levels. The
            last level has at least the variance of a pixel, 1/12, unless this is 0.
        smooth: Whether the asset is smooth: its gaussians are about as wide as the
            distances between them, so that one sample per pixel suffices when they are
            seen from near. Coarser levels of a smooth asset have no filter, except the
            last one, which has that of a pixel. A group of level 1 is then selected
            where pictures of the asset show that it looks no worse than its leaves, or
            at half the size if there are more than a million leaves. With "measured",
            and if levels are fitted with a filter, a measurement decides: some groups
            of level 1 are fitted with 0.05 px² and without a filter, and the asset is
            smooth if the filter hardly improves it.
        asset_filter_px2: The filter of level 0. None means no filter, or the filter of
            the training if the asset is antialiased. The filter used for training (0.3
            for the original 3DGS) suits pictures of the size of the photographs;
            without a filter, the asset looks better from farther away. Coarser levels
            are always fitted to the asset without a filter.
        asset_antialiased: Whether the asset was trained with opacities that compensate
            for its filter. None uses the asset's own value (`Gaussians.antialiased`),
            or False if that is None.
        loss_l1, loss_dssim, loss_alpha: Weights of the parts of the loss.
        step_position: Step size of positions, in radii of the group, or in world units
            if `position_in_world`. `step_log_scale`, `step_quat`, `step_logit`,
            `step_sh0` and `step_sh_rest` are the step sizes of log scales, quaternions,
            opacity logits, and SH coefficients of degree 0 and of higher degrees.
        final_step: The factor by which the step sizes have decayed exponentially at the
            last step.
        beta2: Decay of Adam's running mean of squared gradients.

    Raises:
        ValueError: A setting has the wrong type or is out of range, or all views of a
            group together have too many pixels.
    """

    cluster_size: Annotated[int, (2, 1 << 30)] = 256
    group_size: Annotated[int, (2, 1 << 30)] = 2
    # Only Python code reads these counts, so they may exceed 32 bits. With the largest
    # values, level 0 is the only level.
    min_clusters: Annotated[int, (1, 1 << 62)] = 1
    min_gaussians: Annotated[int, (1, 1 << 62)] = 1
    init: Literal["merge", "prune"] = "merge"
    # The growth of one level.
    prune_growth: Annotated[float, (0.001, 1000)] = 2 ** (1 / 6)
    targets: Literal["finest", "previous"] = "finest"
    # A fit with the largest value takes hours.
    steps: Annotated[int, (0, 1_000_000)] = 600
    first_steps: Annotated[int, (0, 1_000_000)] = 150
    # The limit exists because a step cannot be interrupted.
    views_per_step: Annotated[int, (1, 1024)] = 2
    # All views are drawn before the first step.
    num_views: Annotated[int, (0, 1 << 16)] = 64
    # Up to 64 x 64 samples are averaged in each pixel.
    supersample: Annotated[int, (1, 64)] = 3
    image_size: Annotated[int, (0, _MOST_SIDE)] = 0
    # At the upper bound, a gaussian covers about 1000 x 1000 px.
    px2_per_gaussian: Annotated[float, (0.001, 1_000_000)] = 2.0
    # The lower bound keeps the camera outside the ball. Beyond the upper bound, float32
    # depths are spaced more widely than gaussians are.
    distance: Annotated[float, (1.1, 1000)] = 4.0
    filter_px2: _Weight = 0.05
    smooth: Literal["measured", "yes", "no"] = "measured"
    asset_filter_px2: _Weight | None = None
    asset_antialiased: bool | None = None
    loss_l1: _Weight = 1.0
    loss_dssim: _Weight = 0.0
    loss_alpha: _Weight = 0.5
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
        """Return the side, px, of a view of a group of `num_gaussians`, as fit_view()
        of the core chooses it."""
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

        The lowest levels are seen most, so each of them starts from the fitted level
        below. The levels above have few groups and would take long one after another;
        so they are initialised together, by repeated merging of the last fitted level.
        """
        end = min(end, first + self._visible_levels)
        stop = first + 1
        if self.target_of(first) > 0 and self.targets == "finest":
            while stop < end and self.steps_at(stop) == self.steps_at(first):
                stop += 1
        return range(first, stop)

    @property
    def _visible_levels(self) -> int:
        """The number of levels below a level whose detail its target pictures show:
        down to gaussians about as small as half a sample."""
        px2 = self.px2_per_gaussian
        if self.image_size > 0:  # the ball covers about 0.4 of the picture
            px2 = 0.4 * self.image_size**2 / (self.cluster_size * self.group_size / 2)
        return 1 + max(1, math.ceil(math.log2(px2 * self.supersample**2)))

    def of_asset(self, *, antialiased: bool | None) -> "BuildConfig":
        """Return these settings with the filter of an asset filled in; `antialiased` is
        the asset's own declaration, None without one."""
        if self.asset_antialiased is not None:
            antialiased = self.asset_antialiased
        filter_px2 = self.asset_filter_px2
        if filter_px2 is None:
            filter_px2 = 0.0
            if antialiased:
                filter_px2 = TRAINED_FILTER_PX2
        return replace(self, asset_antialiased=bool(antialiased), asset_filter_px2=filter_px2)

    def contradiction(self, *, antialiased: bool | None) -> str:
        """Return a description of the contradiction between these settings and the
        asset's own declaration; empty if they agree."""
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
        """Return settings that make level 0 the only level."""
        return BuildConfig(min_clusters=1 << 31)

    @staticmethod
    def paper(**changes: _Setting) -> "BuildConfig":
        """Return the settings of the paper and its code (V3DG, sections 3.2 and 5.1),
        with `changes` to them.

        They are: 4,096 gaussians per cluster and two clusters per group; stop at two
        clusters; prune, and grow scales by 2^(1/6); 640 new random views of 64 x 64 px
        at four radii, compared with the previous level without a filter; a loss of 0.8
        L1 + 0.2 D-SSIM + 0.1 alpha.
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
