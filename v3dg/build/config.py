"""How a bundle is built."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

# Of a side of a picture, in pixels.
_MAX_IMAGE_SIZE = 65535


@dataclass(frozen=True)
class BuildConfig:
    """How a bundle is built. The defaults are ours, with the reasons in docs/levels.md; `paper()` is V3DG's.

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
        supersample: Targets are drawn this much larger and box-averaged.
        image_size: Side of the views in px; 0 shows a group at the size at which it will be selected.
        px2_per_gaussian: That size: px² of the group's footprint for each gaussian that it is simplified to.
        distance: From the camera to the centre of the group, in radii.
        filter_px2: Variance of the low-pass that the coarser levels are drawn with, px².
        asset_filter_px2: The same for level 0: what the asset was trained with (0.3 for the original 3DGS).
        asset_antialiased: Whether the asset was trained with opacities compensated for its filter.
        loss_l1, loss_dssim, loss_alpha: Weights of the parts of the loss.
        step_position: Step size of positions, in radii of the group, or in world units if
            `position_in_world`; the others are of log scales, quaternions, logits and SH coefficients.
        final_step: What the step sizes have fallen to in the end, exponentially.
    """

    cluster_size: int = 256
    group_size: int = 2
    min_clusters: int = 1
    min_gaussians: int = 4
    init: Literal["merge", "prune"] = "merge"
    prune_growth: float = 2 ** (1 / 6)
    targets: Literal["finest", "previous"] = "finest"
    steps: int = 800
    first_steps: int = 200
    views_per_step: int = 2
    num_views: int = 64
    supersample: int = 4
    image_size: int = 0
    px2_per_gaussian: float = 2.0
    distance: float = 4.0
    filter_px2: float = 0.05
    asset_filter_px2: float = 0.0
    asset_antialiased: bool = False
    loss_l1: float = 1.0
    loss_dssim: float = 0.0
    loss_alpha: float = 0.5
    step_position: float = 0.0035
    position_in_world: bool = False
    step_log_scale: float = 0.04
    step_quat: float = 0.014
    step_logit: float = 0.05
    step_sh0: float = 0.04
    step_sh_rest: float = 0.01
    final_step: float = 0.1

    def __post_init__(self) -> None:
        def require(name: str, good: bool, expected: str) -> None:
            if not good:
                raise ValueError(f"{name}: expected {expected}, got {getattr(self, name)!r}")

        kinds: dict[Any, tuple[Any, str]] = {
            "int": (int, "a whole number"),
            "float": ((int, float), "a number"),
            "bool": (bool, "True or False"),
        }
        for field in fields(self):
            if field.type in kinds:
                kind, expected = kinds[field.type]
                value = getattr(self, field.name)
                is_flag = isinstance(value, bool)
                require(field.name, isinstance(value, kind) and is_flag == (kind is bool), expected)
        require("cluster_size", self.cluster_size >= 2, "at least 2")
        for name in ("min_clusters", "min_gaussians", "views_per_step", "supersample"):
            require(name, getattr(self, name) >= 1, "at least 1")
        for name in ("steps", "first_steps", "num_views", "image_size"):
            require(name, getattr(self, name) >= 0, "at least 0")
        for name in ("px2_per_gaussian", "prune_growth", "final_step"):
            require(name, 0 < getattr(self, name) < math.inf, "a positive number")
        for field in fields(self):
            if field.name.startswith(("loss_", "step_")) or field.name.endswith("filter_px2"):
                require(field.name, 0 <= getattr(self, field.name) < math.inf, "a number of at least 0")
        require(
            "image_size",
            self.image_size * self.supersample <= _MAX_IMAGE_SIZE,
            f"at most {_MAX_IMAGE_SIZE} px with `supersample` times as many pixels",
        )
        size = self.group_size
        require("group_size", size >= 2 and size & (size - 1) == 0, "a power of two of at least 2")
        require("init", self.init in ("merge", "prune"), "'merge' or 'prune'")
        require("targets", self.targets in ("finest", "previous"), "'finest' or 'previous'")
        require(
            "distance", self.distance > 1.1, "more than 1.1 radii, so that the camera is outside the ball"
        )

    def steps_at(self, level: int) -> int:
        """Steps of the groups of a level."""
        return min(self.steps, self.first_steps << min(max(level - 1, 0), 32))

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
        last = first + 1
        if self.target_of(first) > 0 and self.targets == "finest":
            while last < min(end, first + self._visible_levels) and self.steps_at(last) == self.steps_at(
                first
            ):
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
    def paper(**changes: Any) -> BuildConfig:
        """The settings of the paper and its code (V3DG, section 3.2 and 5.1), with `changes` to them.

        4,096 gaussians a cluster, two clusters a group, stop at two clusters; prune, grow scales by 2^(1/6);
        640 fresh random views of 64 x 64 px at four radii, against the previous level, without a filter;
        0.8 L1 + 0.2 D-SSIM + 0.1 alpha.
        """
        return replace(
            BuildConfig(
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
            ),
            **changes,
        )
