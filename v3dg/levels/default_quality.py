"""Chooses the quality of a build if the user names none."""

import warnings

from v3dg._device import Device
from v3dg.levels.config import BuildConfig
from v3dg.levels.leaves import Leaves
from v3dg.levels.memory import free_on, in_mib
from v3dg.levels.quality import Quality
from v3dg.levels.refine_sizes import refine_bytes


class DraftWarning(UserWarning):
    """Too little memory is free to refine the levels, so they stay unrefined."""


def chosen_quality(
    quality: Quality | None, config: BuildConfig, leaves: Leaves, device: Device, memory: int
) -> Quality:
    """Return the quality of a build. If no quality is named, it is "standard" on a GPU
    that fits levels, and otherwise "draft".

    Args:
        memory: Bytes of the host that the build may use.

    Warns: DraftWarning: Too little memory is free to refine the asset.
    """
    if quality is not None:
        return quality
    if not device.is_cuda or config.steps == 0:
        return "draft"
    count = leaves.num_gaussians
    required = refine_bytes(count, leaves.sh_degree)
    problem = ""
    for name, free in (("host", memory), ("GPU", free_on(device))):
        if required > free and not problem:
            problem = (
                f"refining {count:,} gaussians takes {in_mib(required)} of the {name}, "
                f"which has {in_mib(free)}"
            )
    if not problem:
        return "standard"
    advice = "levels stay as they are built, unless the quality standard is named"
    warnings.warn(f"quality: {problem}; {advice}", DraftWarning, stacklevel=3)
    return "draft"
