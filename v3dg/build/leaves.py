"""The leaves of a build: the gaussians of an asset that can be drawn, in the order of the median split."""

from __future__ import annotations

import warnings
from collections import Counter
from typing import Literal, Protocol

import numpy as np
import numpy.typing as npt

from v3dg import _core, _device, cleaning
from v3dg.build.checkpoint import digest_of
from v3dg.build.config import BuildConfig
from v3dg.gaussians import Gaussians

Unusable = Literal["drop", "refuse"]

PIECE = 1 << 16
"""Gaussians that are read, examined and hashed at a time; the digest of an asset depends on it."""


class Leaves(Protocol):
    """Leaves of a build, wherever they are.

    Attributes:
        num_gaussians: Leaves.
        asset_gaussians: Those of the asset, with those that cannot be drawn.
        dropped: How many of each kind cannot be drawn, as `cleaning` counts them.
        digest: Of the asset; docs/format.md has the definition.
    """

    @property
    def num_gaussians(self) -> int: ...
    @property
    def asset_gaussians(self) -> int: ...
    @property
    def sh_degree(self) -> int: ...
    @property
    def dropped(self) -> dict[str, int]: ...
    @property
    def digest(self) -> str: ...
    def read(self, first: int, last: int) -> Gaussians:
        """Leaves `first` to `last`, on the host, in arrays of their own."""


class MemoryLeaves:
    """The leaves of an asset in memory, on any device.

    Raises:
        ValueError: The asset has no gaussian that can be drawn; or wrong ones, and they are to be refused.
    """

    def __init__(self, asset: Gaussians, config: BuildConfig, unusable: Unusable = "drop") -> None:
        asset = _device.place(asset, _device.of(asset.means))
        tally = Tally()
        drawable = np.concatenate([np.zeros(0, bool), *map(tally.add, parts_of(asset))])
        tally.check(unusable)
        self.num_gaussians = tally.num_drawable
        self.asset_gaussians = len(asset)
        self.sh_degree = asset.sh_degree
        self.dropped = tally.counts
        self.digest = digest_of(asset)
        self._asset = asset
        is_whole = self.num_gaussians == len(asset)
        depth = _core.num_halvings(self.num_gaussians, config.cluster_size)
        order, _ = _core.median_split(
            asset.means if is_whole else asset.means[drawable],
            np.array([0, self.num_gaussians]),
            depth,
        )
        order = _device.to_host(order).astype(np.int32 if len(asset) < 1 << 31 else np.int64)
        self._order = order if is_whole else np.flatnonzero(drawable).astype(order.dtype)[order]

    def read(self, first: int, last: int) -> Gaussians:
        return self._asset.subset(self._order[first:last]).numpy()


def parts_of(gaussians: Gaussians) -> list[Gaussians]:
    """Pieces of them, sharing their memory."""
    return [gaussians.subset(slice(start, start + PIECE)) for start in range(0, len(gaussians), PIECE)]


class Tally:
    """What is found in an asset that is examined a part after the other."""

    def __init__(self) -> None:
        self.num_gaussians = self.num_drawable = self.num_wrong = 0
        self._counts: Counter[str] = Counter()

    def add(self, part: Gaussians) -> npt.NDArray[np.bool_]:
        """Which of the part can be drawn."""
        findings = cleaning.examine(part)
        self.num_gaussians += len(part)
        self.num_drawable += int(findings.drawable.sum())
        self.num_wrong += findings.num_wrong
        self._counts.update(findings.counts)
        return findings.drawable

    @property
    def counts(self) -> dict[str, int]:
        return {kind: self._counts[kind] for kind in cleaning.KINDS if kind in self._counts}

    def check(self, unusable: Unusable) -> None:
        """Refuse an asset that cannot be built, and warn of what is left out."""
        text = cleaning.summary(self.num_gaussians - self.num_drawable, self.num_gaussians, self.counts)
        if self.num_gaussians == 0:
            raise ValueError("asset: expected at least one gaussian, got none")
        if self.num_wrong and unusable == "refuse":
            raise ValueError(f"asset: expected gaussians that can be drawn, got others: {text}")
        if self.num_drawable == 0:
            raise ValueError(f"asset: expected a gaussian that can be drawn, got none: {text}")
        if self.num_wrong:
            warnings.warn(f"asset: {text}; they are left out", cleaning.AssetWarning, stacklevel=3)
