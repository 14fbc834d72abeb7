"""How a bundle is built."""

import math
from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal, get_args, get_origin

from v3dg._numbers import check

# A target is drawn in one go that cannot be interrupted: in about a second.
_MOST_SIDE = 8192
# Samples along a pixel's side, in targets of deep levels; beyond, nothing is gained.
_MOST_SAMPLES = 8
_DEEP = 64  # a level that has them
# Of all views of a group: they are kept, by each thread that fits one, in 16 bytes each.
_MOST_PIXELS_KEPT = 1 << 26

_KINDS: dict[Any, tuple[Any, str]] = {
    int: (int, "a whole number"),
    float: ((int, float), "a number"),
    bool: (bool, "True or False"),
}
_Weight = Annotated[float, (0, 1_000_000)]
_StepSize = Annotated[float, (0, 1_000_000_000)]


@dataclass(frozen=True)
class BuildConfig:
    """How a bundle is built. The defaults are ours, with the reasons in docs/levels.md; `paper()` is V3DG's.

    Numbers have their least and their greatest value beside their type. Whole numbers are 32 bits wide in the
    core, others float32, whose squares and products with each other must be finite, and not 0 where they are
    divided by.

    Attributes:
        cluster_size: Most gaussians in a cluster of level 0.
        group_size: Clusters that are simplified together, a power of two; 2 makes a tree.
        min_clusters: Levels stop before there are fewer clusters than this ...
        min_gaussians: ... or fewer gaussians than this.
        init: Start of a coarser cluster: "merge" alike gaussians in pairs, or "prune" the lesser half.
        prune_growth: Factor for the scales of gaussians that survive pruning.
        targets: What a level is fitted to: the "finest" level below that its views can show, or the
            "previous" one.
        steps: Most steps of Adam for each group; 0 keeps the start.
        first_steps: Steps at level 1; each level takes twice as many as the one below, up to `steps`.
        views_per_step: Views that one step looks at.
        num_views: Views of a group, drawn once; 0 draws a fresh random one each time.
        supersample: Targets of level 1 are drawn this much larger and box-averaged; each two levels take one
            more, up to 8, for what they show is finer: but for targets of the previous level.
        image_size: Side of the views in px; 0 shows a group at the size at which it will be selected.
        px2_per_gaussian: That size: px² of the group's footprint for each gaussian that it is simplified to.
        distance: From the camera to the centre of the group, in radii.
        filter_px2: Variance of the low-pass that the coarser levels are drawn with, px²; the last one with a
            pixel's, 1/12, if that is more, unless this is 0.
        smooth: Whether the asset's gaussians are about as wide as they are far apart, so that one sample a
            pixel shows it well from near. Its coarser levels have no filter, but the last one a pixel's, and
            a group of level 1 is selected where pictures of the asset tell that it is no worse than its
            leaves, or at half the size if there are more than a million leaves. Where levels are fitted, and
            with a filter, it is measured: some groups of level 1 are fitted with 0.05 px² and without, and an
            asset that hardly gains by the filter is smooth.
        asset_filter_px2: The filter of level 0: what the asset was trained with (0.3 for the original 3DGS)
            at the size of its photographs; without, it is better seen from farther away. Coarser levels are
            fitted to the asset without a filter.
        asset_antialiased: Whether the asset was trained with opacities compensated for its filter.
        loss_l1, loss_dssim, loss_alpha: Weights of the parts of the loss.
        step_position: Step size of positions, in radii of the group, or in world units if
            `position_in_world`; the others are of log scales, quaternions, logits and SH coefficients.
        final_step: What the step sizes have fallen to in the end, exponentially.
        beta2: Decay of Adam's running mean of squared gradients.

    Raises:
        ValueError: A setting is of another kind or out of its range, or all views of a group have too many
            pixels to be kept.
    """

    cluster_size: Annotated[int, (2, 1 << 30)] = 256
    group_size: Annotated[int, (2, 1 << 30)] = 2
    # Counts that the core does not see; so many make level 0 the only one.
    min_clusters: Annotated[int, (1, 1 << 62)] = 1
    min_gaussians: Annotated[int, (1, 1 << 62)] = 1
    init: Literal["merge", "prune"] = "merge"
    prune_growth: Annotated[float, (0.001, 1000)] = 2 ** (1 / 6)  # once a level
    targets: Literal["finest", "previous"] = "finest"
    steps: Annotated[int, (0, 1_000_000)] = 600  # at most some hours
    first_steps: Annotated[int, (0, 1_000_000)] = 150
    views_per_step: Annotated[int, (1, 1024)] = 2  # a step is not interrupted
    num_views: Annotated[int, (0, 1 << 16)] = 64  # all are drawn before the first step
    supersample: Annotated[int, (1, 64)] = 3  # at most more samples than a pixel has values
    image_size: Annotated[int, (0, _MOST_SIDE)] = 0
    px2_per_gaussian: Annotated[float, (0.001, 1_000_000)] = 2.0  # a picture for each, at most
    # Outside the ball; from farther, float32 depths are coarser than gaussians.
    distance: Annotated[float, (1.1, 1000)] = 4.0
    filter_px2: _Weight = 0.05
    smooth: Literal["measured", "yes", "no"] = "measured"
    asset_filter_px2: _Weight = 0.0
    asset_antialiased: bool = False
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
            name, value, of = field.name, getattr(self, field.name), get_args(field.type)
            if get_origin(field.type) is Literal:
                self._require(name, value in of, " or ".join(map(repr, of)))
                continue
            kind, *ranges = of or (field.type,)
            classes, expected = _KINDS[kind]
            is_kind = isinstance(value, classes) and isinstance(value, bool) == (kind is bool)
            self._require(name, is_kind, expected)
            for least, most in ranges:
                self._require(name, least <= value <= most, f"{least:,} to {most:,}")
        self._require("group_size", self.group_size.bit_count() == 1, "a power of two")
        self.check_views(1)

    def _require(self, name: str, is_good: bool, expected: str) -> None:
        check(name, is_good, f"{expected}, got {getattr(self, name)!r}")

    def check_views(self, most_gaussians: int) -> None:
        """Refuse, with ValueError, views of too many pixels for groups of at most so many gaussians."""
        side, name = self.image_size, "image_size"
        if side == 0:  # as fit_view() of the core has it
            name, x2 = "px2_per_gaussian", self.distance**-2
            footprint_of_focal = 2 * math.pi * (1 - math.sqrt(1 - x2))
            radius2 = most_gaussians * self.px2_per_gaussian / footprint_of_focal * x2 / (1 - x2)
            side = math.ceil(2 * math.sqrt(radius2)) + 8
        fits = side * self.samples_at(_DEEP) <= _MOST_SIDE and side**2 * self.num_views <= _MOST_PIXELS_KEPT
        most = f"{_MOST_SIDE} px a side with `supersample`, and {_MOST_PIXELS_KEPT} px in all `num_views`"
        found = f"{side} px a side; reduce one of them, or `cluster_size`"
        check(name, fits, f"views of at most {most}, got {found}")

    def steps_at(self, level: int) -> int:
        """Steps of the groups of a level."""
        return min(self.steps, self.first_steps << min(max(level - 1, 0), 32))

    def samples_at(self, level: int) -> int:
        """How much larger targets of a level are drawn."""
        more = 0 if self.targets == "previous" else (level - 1) // 2
        return max(self.supersample, min(self.supersample + more, _MOST_SAMPLES))

    def target_of(self, level: int) -> int:
        """The level that the groups of a level are fitted to.

        A level finer than one with two gaussians for each sample of a target picture shows no more.
        """
        return max(0, level - (1 if self.targets == "previous" else self._visible_levels))

    def levels_at_once(self, first: int, end: int) -> range:
        """Which levels before `end` are fitted together with level `first`.

        The lowest, of which most is seen, start from the fit below; those above, which have few groups and
        would be waited for one after another, from what is merged of the fit below them all.
        """
        last, end = first + 1, min(end, first + self._visible_levels)
        if self.target_of(first) > 0 and self.targets == "finest":
            while last < end and self.steps_at(last) == self.steps_at(first):
                last += 1
        return range(first, last)

    @property
    def _visible_levels(self) -> int:
        """How far below a level gaussians are about as small as half a sample of its target pictures."""
        px2 = self.px2_per_gaussian
        if self.image_size > 0:  # of which the ball covers about 0.4
            px2 = 0.4 * self.image_size**2 / (self.cluster_size * self.group_size / 2)
        return 1 + max(1, math.ceil(math.log2(px2 * self.supersample**2)))

    @staticmethod
    def paper(**changes: Any) -> "BuildConfig":
        """The settings of the paper and its code (V3DG, section 3.2 and 5.1), with `changes` to them.

        4,096 gaussians a cluster, two clusters a group, stop at two clusters; prune, grow scales by 2^(1/6);
        640 fresh random views of 64 x 64 px at four radii, against the previous level, without a filter;
        0.8 L1 + 0.2 D-SSIM + 0.1 alpha.
        """
        settings: dict[str, Any] = {"cluster_size": 4096, "group_size": 2, "min_clusters": 2, "init": "prune"}
        settings |= {"targets": "previous", "steps": 640, "first_steps": 640, "views_per_step": 1}
        settings |= {"num_views": 0, "supersample": 1, "image_size": 64, "filter_px2": 0.0, "smooth": "no"}
        settings |= {"loss_l1": 0.8, "loss_dssim": 0.2, "loss_alpha": 0.1, "position_in_world": True}
        settings |= {"step_position": 1.6e-5, "step_log_scale": 5e-3, "step_quat": 1e-3, "step_logit": 5e-2}
        settings |= {"step_sh0": 2.5e-3, "step_sh_rest": 2.5e-3 / 20, "final_step": 1.0, "beta2": 0.999}
        return BuildConfig(**settings | changes)
