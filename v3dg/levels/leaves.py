"""The leaves of a build: the drawable gaussians of an asset, in the order of the median
split."""

import threading
import warnings
from abc import ABC, abstractmethod
from collections import Counter
from dataclasses import asdict, dataclass
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from v3dg import _core, _device, cleaning
from v3dg._device import Device
from v3dg._json import JsonObject
from v3dg._numbers import check, one_of, value_text, whole_number
from v3dg.bundle.codec import Codec
from v3dg.cameras import Axis
from v3dg.formats._declared import declared_of
from v3dg.gaussians import Gaussians, gaussian_bytes
from v3dg.levels.config import BuildConfig
from v3dg.levels.digest import digest_of
from v3dg.levels.rows import RUN_ROWS

Unusable = Literal["drop", "refuse"]


@dataclass(eq=False)
class Leaves(ABC):
    """The drawable gaussians of an asset, in memory or on disk."""

    num_gaussians: int
    asset_gaussians: int
    sh_degree: int
    dropped: dict[str, int]
    digest: str
    resident_bytes: int  # host memory that the leaves use while they are read
    up: Axis | None  # the axis that points up, if the asset's file declares it
    antialiased: bool | None  # as in `Gaussians`

    def settings(self, config: BuildConfig) -> BuildConfig:
        """Return the settings for building these leaves. Emit an AssetWarning if
        `config` contradicts a declaration of the asset."""
        contradiction = config.contradiction(antialiased=self.antialiased)
        if contradiction:
            warnings.warn(f"asset: {contradiction}", cleaning.AssetWarning, stacklevel=3)
        return config.of_asset(antialiased=self.antialiased)

    @abstractmethod
    def read(self, first: int, last: int) -> Gaussians:
        """Return leaves `first` to `last`, in newly allocated arrays."""


class MemoryLeaves(Leaves):
    """The leaves of an asset in memory, on any device. The first call of `read` sorts
    them on `device`."""

    def __init__(
        self,
        asset: Gaussians,
        config: BuildConfig,
        unusable: Unusable = "drop",
        device: Device = _device.CPU,
        up: Axis | None = None,
    ) -> None:
        is_single = str(asset.means.dtype).endswith("32")
        check("asset", is_single, "float32 arrays, got float64; convert them first")
        one_of(unusable, "unusable", get_args(Unusable))
        tally = Tally()
        host = asset.numpy()
        self._drawable = tally.add(host)
        tally.check(unusable)
        super().__init__(
            num_gaussians=tally.num_drawable,
            asset_gaussians=len(asset),
            sh_degree=asset.sh_degree,
            dropped=tally.counts,
            digest=digest_of(host),
            resident_bytes=len(asset) * (gaussian_bytes(asset.sh_degree) + 4),
            up=up or declared_of(asset).up,
            antialiased=asset.antialiased,
        )
        self._asset = _device.place(asset, _device.of(asset.means))  # drops gradients
        self._config = config
        self._device = device
        self._order: npt.NDArray[np.int32] | npt.NDArray[np.int64] | None = None
        self._lock = threading.Lock()

    def read(self, first: int, last: int) -> Gaussians:
        """Return leaves `first` to `last`, on the device of the asset."""
        with self._lock:
            if self._order is None:
                means = _device.place_rows(self._asset.means, self._drawable, self._device)
                depth = _core.num_halvings(self.num_gaussians, self._config.cluster_size)
                order, _ = _core.median_split(means, np.array([0, self.num_gaussians]), depth)
                rows = np.flatnonzero(self._drawable)
                if self.asset_gaussians < 1 << 31:
                    rows = rows.astype(np.int32)
                self._order = np.take(rows, _device.to_host(order))
        return self._asset.subset(self._order[first:last])


def made_with(
    leaves: Leaves, config: BuildConfig, seed: int, codec: str, up: Axis | None
) -> JsonObject:
    """Return the config that a bundle stores. It has the number of the asset's
    gaussians, their digest and their faults, and the settings of the build."""
    seed = whole_number(seed, "seed")
    check("seed", 0 <= seed < 2**58, f"a whole number from 0 to 2^58 - 1, got {value_text(seed)}")
    result: JsonObject = {
        "build": asdict(config),
        "seed": seed,
        "asset_gaussians": leaves.asset_gaussians,
        "asset_digest": leaves.digest,
        "run_rows": RUN_ROWS,
        "dropped": leaves.dropped,
    }
    if codec != Codec.name:
        result["codec"] = codec
    up = up or leaves.up
    if up is not None:
        result["up"] = up
    return result


class Tally:
    """Counts the gaussians of an asset, and the faults of those that cannot be drawn.
    The asset is passed in parts."""

    def __init__(self) -> None:
        self.num_gaussians = 0
        self.num_drawable = 0
        self.num_wrong = 0
        self._counts: Counter[str] = Counter()

    def add(self, part: Gaussians) -> npt.NDArray[np.bool_]:
        """Count the gaussians of a part.

        Return (N,) whether each of them can be drawn.
        """
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
        """Warn about gaussians that are left out. Raise ValueError if no bundle can be
        built from the asset."""
        text = cleaning.summary(
            self.num_gaussians - self.num_drawable, self.num_gaussians, self.counts
        )
        check("asset", self.num_gaussians, "at least one gaussian, got none")
        is_allowed = not self.num_wrong or unusable != "refuse"
        check(
            "asset",
            is_allowed,
            f"only gaussians that can be drawn, but {text}; unusable='drop' leaves them out",
        )
        check(
            "asset", self.num_drawable, f"at least one gaussian that can be drawn, got none: {text}"
        )
        if self.num_wrong:
            warnings.warn(f"asset: {text}; they are left out", cleaning.AssetWarning, stacklevel=4)
