"""Build a bundle from an asset: split it into clusters, then halve and fit level after level."""

from __future__ import annotations

import _thread
import errno
import fcntl
import hashlib
import json
import math
import operator
import os
import stat
import struct
import threading
import time
import warnings
import weakref
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, fields, replace
from io import FileIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from v3dg import _core, _device, _files, cleaning
from v3dg._device import Device
from v3dg._version import __version__
from v3dg.bundle import Bundle, Clusters, Groups
from v3dg.gaussians import Array, Gaussians

Offsets: TypeAlias = npt.NDArray[np.int64]

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

# Of a side of a picture, in pixels.
_MAX_IMAGE_SIZE = 65535

# Groups of which the start is made at once: a second or so in which Ctrl-C has to wait.
_GROUPS_AT_ONCE = 256

_DIGEST_BYTES = 16
_PIECE_BYTES = 16 << 20


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
        targets: What a level is fitted to: the "leaves" under it or the "previous" level.
        steps: Steps of Adam for each group; 0 keeps the start.
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
    targets: Literal["leaves", "previous"] = "leaves"
    steps: int = 800
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
    step_position: float = 0.005
    position_in_world: bool = False
    step_log_scale: float = 0.04
    step_quat: float = 0.02
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
        for name in ("steps", "num_views", "image_size"):
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
        require("targets", self.targets in ("leaves", "previous"), "'leaves' or 'previous'")
        require(
            "distance", self.distance > 1.1, "more than 1.1 radii, so that the camera is outside the ball"
        )

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


@dataclass(frozen=True, eq=False)
class _Level:
    """One finished level, on the host: clusters in order, and for each the group that made it."""

    gaussians: Gaussians
    offset: Offsets  # (clusters + 1,)
    # Of the groups that made the clusters; at level 0 every cluster is its own.
    group_of_cluster: npt.NDArray[np.int32]
    leaf_range: npt.NDArray[np.int64]  # (groups, 2) gaussians of level 0 under each
    box: npt.NDArray[np.float32]  # (clusters, 2, 3) of what they draw
    ball: npt.NDArray[np.float32]  # (groups, 4), nested, for selection
    weight: npt.NDArray[np.float32]  # (groups,) of its footprint
    error: npt.NDArray[np.float32]  # (groups, 2)

    def next_shape(self, config: BuildConfig) -> tuple[int, int] | None:
        return _next_shape(len(self.offset) - 1, len(self.gaussians), config)


def build_bundle(
    asset: Gaussians,
    *,
    config: BuildConfig | None = None,
    seed: int = 0,
    progress: bool = True,
    device: str | Device = "auto",
    resume_path: str | os.PathLike[str] | None = None,
    unusable: Literal["drop", "refuse"] = "drop",
) -> Bundle:
    """Build all levels of one asset (V3DG, algorithm 1; what we do differently is in docs/levels.md).

    The same asset, config, seed and device give the same bundle, bit for bit, whatever the number of threads
    (on one instruction set or one kind of GPU: others round differently).

    Args:
        asset: At least one gaussian that can be drawn.
        config: Settings; ours by default.
        seed: Of the views that groups are fitted to.
        progress: Show a bar with the level, its groups done, the time left and their mean loss.
        device: Where to compute; the bundle is on the host in any case. "auto" is the asset's or the current
            CUDA device where there is one and torch can use it, else the CPU.
        resume_path: Where to keep finished levels; a build of the same asset, config, seed and device that
            finds them there goes on from them. The file stays: remove it once the bundle is saved.
        unusable: Whether gaussians with wrong values (not finite, negative scales, opacities outside 0 to 1)
            are left out, with a `v3dg.cleaning.AssetWarning`, or are an error. Those that no pixel can show,
            because their opacity is below 1/255, are left out in any case. How many of each kind is kept in
            the bundle's config as "dropped".

    Raises:
        ValueError: The asset has nothing that can be drawn, or a setting is wrong.
        RuntimeError: The device is "cuda", and something is missing for it; or another build is using
            `resume_path`.
        OSError: `resume_path` cannot be written; the levels before are whole.
        MemoryError: The device has too little memory; the message has the numbers.
        KeyboardInterrupt: Ctrl-C; threads have stopped, finished levels are at `resume_path`.
    """
    config = config or BuildConfig()
    where = _device.resolve(device)
    if where.is_cuda and str(device) in ("auto", "cuda") and _device.of(asset.means).is_cuda:
        where = _device.of(asset.means)
    if not isinstance(progress, bool):
        raise TypeError(f"progress: expected True or False, got {progress!r}")
    seed = operator.index(seed)
    if not 0 <= seed < 2**58:
        raise ValueError(f"seed: expected 0 to 2^58 - 1, got {seed}")
    if str(asset.means.dtype).endswith("64"):
        raise ValueError("asset: expected float32 arrays, got float64; convert them first")
    if unusable not in ("drop", "refuse"):
        raise ValueError(f"unusable: expected 'drop' or 'refuse', got {unusable!r}")
    with _device.memory_errors():
        placed, dropped = _drawable_part(_device.place(asset, where), unusable)
        store = _Checkpoint(resume_path, placed, config, seed, where)
        build = _Build(placed, config, seed)
        del placed  # twice is enough: the caller's, and in the order of the leaves
        with store:
            for level in store.load():
                build.append(level)
            bar = _Bar(build.levels, config, progress)
            try:
                while (shape := build.levels[-1].next_shape(config)) is not None:
                    _simplify(build, shape, bar)
                    store.save(build.levels[-1])
            finally:
                bar.close()
    made_with = {"build": asdict(config), "seed": seed, "asset_gaussians": len(asset), "dropped": dropped}
    return _assemble(build.levels, build.pile.gaussians, config, made_with)


def _drawable_part(asset: Gaussians, unusable: str) -> tuple[Gaussians, dict[str, int]]:
    """The gaussians that can be drawn, and how many of each kind could not."""
    if len(asset) == 0:
        raise ValueError("asset: expected at least one gaussian, got none")
    findings = cleaning.examine(asset)
    if findings.num_wrong and unusable == "refuse":
        raise ValueError(f"asset: expected gaussians that can be drawn, got others: {findings.text}")
    if not findings.drawable.any():
        raise ValueError(f"asset: expected a gaussian that can be drawn, got none: {findings.text}")
    if findings.num_wrong:
        warnings.warn(f"asset: {findings.text}; they are left out", cleaning.AssetWarning, stacklevel=3)
    if findings.num_dropped:
        asset = asset.subset(findings.drawable)
    return asset, findings.counts


class _Pile:
    """The gaussians of all levels, one level after another, on the host: what the bundle will hold."""

    def __init__(self, count: int, like: Gaussians) -> None:
        shapes = [getattr(like, field.name).shape[1:] for field in fields(Gaussians)]
        self.gaussians = Gaussians(*(np.empty((count, *shape), np.float32) for shape in shapes))
        self._filled = 0

    def add(self, gaussians: Gaussians) -> Gaussians:
        """Copy a level's gaussians, from any device; returns the copy."""
        first, self._filled = self._filled, self._filled + len(gaussians)
        copy = self.gaussians.subset(slice(first, self._filled))
        for field in fields(Gaussians):
            _device.copy_to_host(getattr(gaussians, field.name), getattr(copy, field.name))
        return copy


class _Build:
    """The levels so far, and what the next one is made from, on the device that builds."""

    def __init__(self, asset: Gaussians, config: BuildConfig, seed: int) -> None:
        self.config, self.seed = config, seed
        self.where = _device.of(asset.means)
        self.levels: list[_Level] = []
        count = len(asset)
        depth = _core.num_halvings(count, config.cluster_size)
        order, offset = _core.median_split(asset.means, np.array([0, count]), depth)
        sizes = np.diff(offset)
        self.pile = _Pile(len(asset) + sum(_sizes_ahead(sizes, config)), asset)
        leaves = asset.subset(order)
        self._spheres = _spheres(leaves)
        self.append(
            _Level(
                leaves,
                offset,
                np.arange(len(sizes), dtype=np.int32),
                np.stack([offset[:-1], offset[1:]], axis=1),
                _device.to_host(_core.bound_by_boxes(leaves.rows, offset)),
                _device.to_host(_core.bound_spheres(self._spheres, offset)),
                np.zeros(len(sizes), np.float32),
                np.zeros((len(sizes), 2), np.float32),
            )
        )
        self.leaves = self.last
        self.target_leaves = _core.FitTarget(
            self.leaves.rows, config.asset_filter_px2, config.asset_antialiased
        )
        self._ball_of_leaves = np.zeros((0, 2), np.int64), np.zeros((0, 4), np.float32)

    def append(self, level: _Level) -> None:
        """Add a finished level, whose gaussians are on any device."""
        copy = self.pile.add(level.gaussians)
        self.levels.append(replace(level, gaussians=copy))
        self.last = copy if not self.where.is_cuda else _device.place(level.gaussians, self.where)

    def balls_of_leaves(self, leaf_range: npt.NDArray[np.int64]) -> npt.NDArray[np.float32]:
        """Balls around the gaussians of level 0 under each group, which are what the fit looks at."""
        known_range, ball = self._ball_of_leaves
        # Past the root, every level stands for all leaves.
        if not np.array_equal(known_range, leaf_range):
            offset = np.append(leaf_range[:, 0], leaf_range[-1, 1])
            ball = _device.to_host(_core.bound_spheres(self._spheres, offset))
            self._ball_of_leaves = leaf_range, ball
        return ball


def _next_shape(clusters: int, gaussians: int, config: BuildConfig) -> tuple[int, int] | None:
    """Groups that a level's clusters form, and clusters each makes; None after the last level."""
    num_groups = max(1, clusters // config.group_size)
    made = max(1, clusters // num_groups // 2)
    if num_groups * made < config.min_clusters or gaussians // 2 < config.min_gaussians:
        return None
    return num_groups, made


def _sizes_ahead(sizes: npt.NDArray[np.int64], config: BuildConfig) -> list[int]:
    """Gaussians of each level above one whose clusters have `sizes`."""
    ahead = []
    while (shape := _next_shape(len(sizes), int(sizes.sum()), config)) is not None:
        num_groups, made = shape
        sizes = (sizes.reshape(num_groups, -1).sum(axis=1) + 1) // 2
        ahead.append(int(sizes.sum()))
        while len(sizes) < num_groups * made:
            sizes = np.stack([(sizes + 1) // 2, sizes // 2], axis=1).ravel()
    return ahead


def _spheres(gaussians: Gaussians) -> Array:
    """(N, 4) centre and largest scale of each gaussian."""
    library = _device.library_of(gaussians.means)
    radius = library.amax(gaussians.scales, axis=1, keepdims=True)
    return library.concatenate([gaussians.means, radius], axis=1)


def _simplify(build: _Build, shape: tuple[int, int], bar: _Bar) -> None:
    """Add the next level."""
    config, below, number = build.config, build.levels[-1], len(build.levels)
    num_groups, clusters_made = shape
    per_group = (len(below.offset) - 1) // num_groups
    offset = np.ascontiguousarray(below.offset[::per_group])
    out_offset = np.concatenate([[0], np.cumsum((np.diff(offset) + 1) // 2)])
    gaussians = _start(build.last, offset, out_offset, config)

    # Groups nest: this level's are runs of whole groups of the level below.
    first_group = below.group_of_cluster[np.arange(num_groups) * per_group]
    last_group = below.group_of_cluster[np.arange(1, num_groups + 1) * per_group - 1]
    child_offset = np.append(first_group, last_group[-1] + 1).astype(np.int64)
    leaf_range = np.stack([below.leaf_range[first_group, 0], below.leaf_range[last_group, 1]], axis=1)
    weight = np.maximum(
        (1 / np.diff(out_offset)).astype(np.float32), np.maximum.reduceat(below.weight, child_offset[:-1])
    )

    from_leaves = config.targets == "leaves"
    own_filter = from_leaves or number == 1
    bar.start_level(number, num_groups, int(out_offset[-1]))
    ball = build.balls_of_leaves(leaf_range)
    target = build.target_leaves
    if not from_leaves:
        own = config.asset_filter_px2, config.asset_antialiased
        target = _core.FitTarget(build.last.rows, *(own if own_filter else (config.filter_px2, True)))
    _device.spare_memory(build.where)
    errors = []
    rows = gaussians.rows

    def fit(progress: _core.FitProgress) -> None:
        errors.append(
            _core.fit_level(
                _fit_config(config, build.seed, number),
                target,
                leaf_range if from_leaves else np.stack([offset[:-1], offset[1:]], axis=1),
                rows,
                np.stack([out_offset[:-1], out_offset[1:]], axis=1),
                ball,
                np.arange(num_groups),
                progress,
            )
        )

    _run_fit(bar, build.where, fit)
    cluster_offset = out_offset
    if clusters_made > 1:
        depth = clusters_made.bit_length() - 1
        order, cluster_offset = _core.median_split(gaussians.means, out_offset, depth)
        gaussians = gaussians.subset(order)
    build.append(
        _Level(
            gaussians,
            cluster_offset,
            np.repeat(np.arange(num_groups, dtype=np.int32), clusters_made),
            leaf_range,
            _device.to_host(_core.bound_by_boxes(gaussians.rows, cluster_offset)),
            _core.bound_spheres(below.ball, child_offset),
            weight,
            errors[0],
        )
    )


def _start(gaussians: Gaussians, offset: Offsets, out_offset: Offsets, config: BuildConfig) -> Gaussians:
    """What groups start from: their gaussians halved, from `offset` to `out_offset`."""
    parts = []
    num_groups = len(offset) - 1
    at_once = _GROUPS_AT_ONCE if isinstance(gaussians.means, np.ndarray) else num_groups
    for first in range(0, num_groups, at_once):
        cuts, out_cuts = (o[first : first + at_once + 1] for o in (offset, out_offset))
        part = gaussians.subset(slice(cuts[0], cuts[-1]))
        cuts, out_cuts = cuts - cuts[0], out_cuts - out_cuts[0]
        if config.init == "merge":
            parts.append(Gaussians(*_core.merge(part.rows, cuts, out_cuts)))
        else:
            kept = part.subset(_core.prune(part.rows, cuts, out_cuts))
            parts.append(replace(kept, scales=kept.scales * np.float32(config.prune_growth)))
    return parts[0] if len(parts) == 1 else Gaussians.concatenate(parts)


def _fit_config(config: BuildConfig, seed: int, level: int) -> Any:
    names = (field.name for field in fields(config))
    settings = {name: getattr(config, name) for name in names if name in _FIT_SETTINGS}
    # Every level has views of its own.
    return _core.FitConfig(**settings, antialiased=True, seed=seed * 64 + level)


_FIT_SETTINGS = frozenset(
    (
        *(
            "steps",
            "views_per_step",
            "num_views",
            "supersample",
            "image_size",
            "px2_per_gaussian",
            "distance",
        ),
        *(
            "filter_px2",
            "loss_l1",
            "loss_dssim",
            "loss_alpha",
            "step_position",
            "step_log_scale",
            "step_quat",
        ),
        *("step_logit", "step_sh0", "step_sh_rest", "position_in_world", "final_step"),
    )
)


def _run_fit(bar: _Bar, where: Device, fit: Callable[[_core.FitProgress], None]) -> None:
    """Run `fit` on a thread of its own, so that Ctrl-C and the bar stay alive while it computes."""
    state = _core.FitProgress()
    fit = _device.with_this_stream(fit, where)
    failure: list[BaseException] = []
    done = threading.Event()

    def work(token: _Token) -> None:
        del token  # the thread itself still has it
        try:
            fit(state)
        except BaseException as error:
            failure.append(error)
        finally:
            done.set()

    # Not threading.Thread: its start waits for ever for a thread that ends, for want of memory, before its
    # first line; and Ctrl-C during its join can make Python 3.11 take it for finished while it runs.
    tokens = [_Token()]
    runs = weakref.ref(tokens[0])
    try:
        _thread.start_new_thread(work, (tokens.pop(),))
        while runs() is not None and not done.wait(0.1):
            bar.show(state)
    except BaseException:
        state.cancel()
        while runs() is not None and not done.is_set():
            time.sleep(0.01)
        raise
    if failure:
        raise failure[0]
    if not done.is_set():
        raise MemoryError("a thread that had started ended at once")
    bar.show(state)


class _Token:
    """Goes when whoever holds it does."""


class _Bar:
    """One bar over all levels; it advances by fitted gaussians, which is what time goes with."""

    def __init__(self, levels: list[_Level], config: BuildConfig, visible: bool) -> None:
        self._bar: Any = None
        if not visible:
            return
        from tqdm import tqdm

        ahead = _sizes_ahead(np.diff(levels[-1].offset), config)
        before = sum(len(level.gaussians) for level in levels[1:])
        self._last_level = len(levels) - 1 + len(ahead)
        self._num_groups = self._num_gaussians = 0
        self._finished = before
        self._bar = tqdm(
            total=before + sum(ahead),
            initial=before,
            unit=" gaussians",
            unit_scale=True,
            smoothing=0.1,
            dynamic_ncols=True,
        )

    def start_level(self, level: int, num_groups: int, num_gaussians: int) -> None:
        if self._bar is None:
            return
        self._finished += self._num_gaussians
        self._num_groups, self._num_gaussians = num_groups, num_gaussians
        self._bar.set_description(f"level {level}/{self._last_level}")

    def show(self, state: _core.FitProgress) -> None:
        """Show how many groups of the level are done."""
        groups_done = state.groups_done
        if self._bar is None or groups_done == 0:
            return
        loss = state.loss_sum / groups_done
        self._bar.set_postfix_str(f"groups {groups_done}/{self._num_groups}, loss {loss:.4f}", refresh=False)
        self._bar.update(self._finished + self._num_gaussians * groups_done // self._num_groups - self._bar.n)

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()


class _Checkpoint:
    """Finished levels in a file that grows by one after each; the first, the leaves, is quicker to make anew.

    A level whose writing was cut off does not count; one that is whole but damaged is an error. The file is
    locked while a build uses it, and is gone after one that finished no level.
    """

    _COUNTS = struct.Struct("<qqq")  # gaussians, clusters, groups

    def __init__(
        self,
        path: str | os.PathLike[str] | None,
        asset: Gaussians,
        config: BuildConfig,
        seed: int,
        device: Device,
    ) -> None:
        self._path = None if path is None else Path(path)
        if self._path is None:
            return
        what = [asdict(config), seed, _device.describe(device), __version__, len(asset), asset.sh_degree]
        text = json.dumps(what, sort_keys=True).encode()
        self._head = b"v3dg levels 2\n" + _digest(text, _arrays_of(asset.numpy()))
        self._num_sh = asset.sh.shape[1]
        self._num_bytes = 0  # of the file that are good

    def __enter__(self) -> _Checkpoint:
        if self._path is not None:
            if not self._path.parent.is_dir():
                raise ValueError(f"resume_path: expected a file in an existing folder, got {self._path}")
            self._file = _open_locked(self._path)
        return self

    def __exit__(self, *_: object) -> None:
        if self._path is not None:
            if os.fstat(self._file.fileno()).st_size == 0:
                self._path.unlink(missing_ok=True)
            self._file.close()

    def load(self) -> list[_Level]:
        """The finished levels but the leaves."""
        if self._path is None:
            return []
        levels = []
        try:
            head = self._file.read(len(self._head))
            is_ours = self._head.startswith(head)
            while is_ours and (level := self._read()) is not None:
                levels.append(level)
                self._num_bytes = self._file.tell()
        except (OSError, ValueError) as error:
            raise ValueError(
                f"{self._path}: expected levels of an interrupted build, could not read them "
                f"({error}); remove it to start again"
            ) from error
        if not is_ours:
            raise ValueError(
                f"{self._path}: holds something else, or levels of another asset, config, seed, device or "
                "version; remove it to start again"
            )
        return levels

    def _read(self) -> _Level | None:
        """The next level; None where the file ends before it does."""
        counts, digest = self._file.read(self._COUNTS.size), self._file.read(_DIGEST_BYTES)
        if len(digest) < _DIGEST_BYTES:
            return None
        if min(self._COUNTS.unpack(counts)) < 0:
            raise ValueError("a level is damaged")
        layout = self._layout(*self._COUNTS.unpack(counts))
        left = os.fstat(self._file.fileno()).st_size - self._file.tell()
        if sum(dtype.itemsize * math.prod(shape) for dtype, shape in layout) > left:
            return None
        arrays = [np.fromfile(self._file, dtype, math.prod(shape)).reshape(shape) for dtype, shape in layout]
        if _digest(counts, arrays) != digest:
            raise ValueError("a level is damaged")
        return _Level(Gaussians(*arrays[:5]), *arrays[5:])

    def save(self, level: _Level) -> None:
        """Add a level that is on the host; what a full disk cuts off is removed again."""
        if self._path is None:
            return
        arrays = [*_arrays_of(level.gaussians), *(getattr(level, field.name) for field in fields(_Level)[1:])]
        counts = self._COUNTS.pack(len(level.gaussians), len(level.group_of_cluster), len(level.ball))
        descriptor = self._file.fileno()
        os.ftruncate(descriptor, self._num_bytes)
        self._file.seek(self._num_bytes)
        with _files.naming_errors(self._path):
            try:
                if self._num_bytes == 0:
                    _write_all(descriptor, self._head)
                _write_all(descriptor, counts + _digest(counts, arrays))
                for array in arrays:
                    _write_all(descriptor, array.reshape(-1).view(np.uint8).data)
            except OSError:
                os.ftruncate(descriptor, self._num_bytes)
                raise
        self._num_bytes = self._file.tell()

    def _layout(self, n: int, clusters: int, groups: int) -> list[tuple[np.dtype[Any], tuple[int, ...]]]:
        """Dtype and shape of the arrays of a level, in order."""
        real = [(n, 3), (n, 4), (n, 3), (n,), (n, self._num_sh, 3)]
        tables: list[tuple[Any, tuple[int, ...]]] = [
            (np.int64, (clusters + 1,)),
            (np.int32, (clusters,)),
            (np.int64, (groups, 2)),
            (np.float32, (clusters, 2, 3)),
            (np.float32, (groups, 4)),
            (np.float32, (groups,)),
            (np.float32, (groups, 2)),
        ]
        return [(np.dtype(dtype), shape) for dtype, shape in [*((np.float32, s) for s in real), *tables]]


def is_current(
    bundle_path: str | os.PathLike[str], asset_path: str | os.PathLike[str], config: BuildConfig, seed: int
) -> bool:
    """Whether a bundle is there, was made with these settings, and its asset's file has not changed since."""
    bundle_path = Path(bundle_path)
    if not bundle_path.is_file() or bundle_path.stat().st_mtime_ns < os.stat(asset_path).st_mtime_ns:
        return False
    try:
        made_with = Bundle.open(bundle_path).config
    except ValueError:  # damaged, or of another version: build it again
        return False
    is_ours = made_with.keys() >= {"build", "seed", "asset_gaussians", "dropped"}
    return bool(is_ours and made_with["build"] == asdict(config) and made_with["seed"] == seed)


def discard_levels(resume_path: str | os.PathLike[str]) -> None:
    """Remove what an interrupted build left there, if anything.

    Raises:
        RuntimeError: A build is using it.
    """
    if os.path.lexists(resume_path):
        with _open_locked(resume_path):
            os.unlink(resume_path)


def _open_locked(path: str | os.PathLike[str]) -> FileIO:
    """Open or make a file to read and write; other builds are kept out until it is closed."""
    # O_NONBLOCK: opening a pipe must not wait for a writer; regular files ignore it.
    flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NONBLOCK
    file = FileIO(path, "r+", opener=lambda name, _: os.open(name, flags, 0o666))
    try:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise ValueError(f"{os.fspath(path)}: expected a file of levels, got a device or a pipe")
        _lock(file)
    except BaseException:
        file.close()
        raise
    return file


def _lock(file: FileIO) -> None:
    try:
        fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise RuntimeError(
            f"{os.fspath(file.name)}: another build is using it; wait for it, or write to another place"
        ) from None
    except OSError as error:
        # Some network file systems have no locks; there, two builds of one output are the user's to avoid.
        if error.errno not in (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP):
            raise


def _arrays_of(g: Gaussians) -> tuple[Any, ...]:
    return g.means, g.quats, g.scales, g.opacities, g.sh


def _write_all(descriptor: int, data: bytes | memoryview) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(descriptor, view[:_PIECE_BYTES]) :]


def _digest(head: bytes, arrays: Sequence[npt.NDArray[Any]]) -> bytes:
    """Of the head and the arrays' bytes; in pieces, so that all cores share the work."""
    pieces: list[Any] = [head]
    for array in arrays:
        data = memoryview(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
        pieces += [data[i : i + _PIECE_BYTES] for i in range(0, len(data), _PIECE_BYTES)]

    def digest(piece: Any) -> bytes:
        return hashlib.blake2b(piece, digest_size=_DIGEST_BYTES).digest()

    if sum(array.nbytes for array in arrays) < _PIECE_BYTES:  # less work than starting threads
        return digest(b"".join(map(digest, pieces)))
    with ThreadPoolExecutor(min(os.cpu_count() or 1, 16)) as pool:
        return digest(b"".join(pool.map(digest, pieces)))


def _assemble(
    levels: list[_Level], gaussians: Gaussians, config: BuildConfig, made_with: dict[str, Any]
) -> Bundle:
    """The bundle of all levels, whose `gaussians` follow one another."""
    cluster_level, own, parent, boxes, offsets = [], [], [], [], [np.zeros(1, np.int64)]
    group_parent = []
    first_group = [0]
    for level in levels[1:]:
        first_group.append(first_group[-1] + len(level.ball))
    for i, level in enumerate(levels):
        count = len(level.offset) - 1
        cluster_level.append(np.full(count, i, np.int32))
        offsets.append(offsets[-1][-1] + level.offset[1:])
        boxes.append(level.box)
        own.append(
            np.full(count, -1, np.int32) if i == 0 else level.group_of_cluster + np.int32(first_group[i - 1])
        )
        if i + 1 == len(levels):
            parent.append(np.full(count, -1, np.int32))
            if i > 0:
                group_parent.append(np.full(len(level.ball), -1, np.int32))
            break
        num_groups = len(levels[i + 1].ball)
        consumer = np.repeat(np.arange(num_groups, dtype=np.int32), count // num_groups) + np.int32(
            first_group[i]
        )
        parent.append(consumer)
        if i > 0:
            up = np.zeros(len(level.ball), np.int32)
            up[level.group_of_cluster] = consumer
            group_parent.append(up)

    def joined(parts: list[Any], dtype: Any, *shape: int) -> Any:
        return np.concatenate(parts).astype(dtype) if parts else np.zeros((0, *shape), dtype)

    fine = len(levels[0].offset) - 1
    count = sum(len(level.offset) - 1 for level in levels)
    clusters = Clusters(
        offset=np.concatenate(offsets),
        level=joined(cluster_level, np.int32),
        own_group=joined(own, np.int32),
        parent_group=joined(parent, np.int32),
        box=joined(boxes, np.float32, 2, 3),
        filter_px2=np.where(np.arange(count) < fine, config.asset_filter_px2, config.filter_px2).astype(
            np.float32
        ),
        antialiased=np.where(np.arange(count) < fine, config.asset_antialiased, True).astype(np.uint8),
    )
    groups = Groups(
        ball=joined([level.ball for level in levels[1:]], np.float32, 4),
        weight=joined([level.weight for level in levels[1:]], np.float32),
        parent=joined(group_parent, np.int32),
        level=joined(
            [np.full(len(level.ball), i, np.int32) for i, level in enumerate(levels[1:], 1)], np.int32
        ),
        error=joined([level.error for level in levels[1:]], np.float32, 2),
    )
    return Bundle(
        clusters,
        groups,
        gaussians,
        made_with,
    )
