"""The qualities of a build, which decide whether and for how long levels are refined
together."""

import contextlib
import time
from collections.abc import Callable
from typing import Literal, get_args

from v3dg._device import Device
from v3dg._json import JsonObject
from v3dg._numbers import check, one_of
from v3dg.bundle import Bundle
from v3dg.bundle.parts import divided
from v3dg.levels.refine_sizes import most_leaves, unit_leaves
from v3dg.levels.refined import DROP, Cuts, RefineRequest, default_steps
from v3dg.levels.viewpoints import RECORDED, SeenFrom

Quality = Literal["draft", "standard", "best"]

# Number of pictures of a "standard" refinement: this minimum, plus one for every 100
# gaussians. A large asset needs more pictures, because each shows a smaller part of it.
_LEAST_PICTURES = 18_000
_GAUSSIANS_PER_PICTURE = 100
# "best" uses this many times as many pictures as "standard".
_BEST = 5
# To estimate the time, each of two kinds of pictures is drawn for this long.
_SECONDS_OF_TRIAL = 0.25


def refinement_of(
    quality: Quality, num_gaussians: int, sh_degree: int, seed: int, seen_from: SeenFrom = "auto"
) -> RefineRequest | None:
    """Return the refinement for an asset of this many gaussians, or None for a
    draft."""
    one_of(quality, "quality", get_args(Quality))
    one_of(seen_from, "seen_from", get_args(SeenFrom))
    if quality == "draft":
        check(
            "seen_from",
            seen_from == "auto",
            f"auto for levels that are not refined, got {seen_from}; name the quality standard",
        )
        return None
    pictures = pictures_of(quality, num_gaussians, sh_degree)
    return RefineRequest(pictures, DROP, seed, seen_from)


def refined_settings(request: RefineRequest, bundle: Bundle, settings: JsonObject) -> JsonObject:
    """Return the config of a bundle after building and refining it with these settings.
    Entries that depend on the gaussians, such as the number of eyes, are copied from
    the bundle."""
    if bundle.num_levels < 2:
        return settings
    record = request.record()
    record_of_bundle = bundle.config.get("refined")
    if isinstance(record_of_bundle, dict):
        record |= {n: record_of_bundle[n] for n in RECORDED if n in record_of_bundle}
    return {**settings, "refined": record}


def pictures_of(quality: Literal["standard", "best"], num_gaussians: int, sh_degree: int) -> int:
    """Return the number of pictures for refining an asset of this many gaussians. If it
    is refined in several units, this is the number for each."""
    leaves = unit_leaves(num_gaussians, sh_degree)
    pictures = _LEAST_PICTURES + leaves // _GAUSSIANS_PER_PICTURE
    if quality == "best":
        pictures *= _BEST
    return pictures


def estimated_seconds(bundle: Bundle, device: Device) -> float:
    """Estimate how long a standard refinement of a bundle takes on a device. It is
    extrapolated from its first pictures, or from those of its first unit."""
    pictures = pictures_of("standard", bundle.num_leaves, bundle.sh_degree)
    division = divided(bundle, most_leaves(bundle.sh_degree))
    if division is not None:
        bundle = division.units[0].of(bundle)
        pictures *= len(division.units) + 1
    steps = default_steps(device)

    def trial(work: Callable[[Cuts], object]) -> float:
        count = [0]
        start = time.perf_counter()

        def stop(num_done: int, *_: object) -> None:
            count[0] = num_done
            if num_done > 0 and time.perf_counter() - start > _SECONDS_OF_TRIAL:
                raise _Enough

        with contextlib.suppress(_Enough):
            work(Cuts(bundle, (), 0, device, stop))
        return (time.perf_counter() - start) / max(count[0], 1)

    # At the beginning, each picture of a refinement also draws the asset, which most
    # later pictures do not. Pictures that weigh gaussians never draw it.
    cut = trial(lambda cuts: cuts.weights(_LEAST_PICTURES))
    cut_and_asset = trial(lambda cuts: cuts.refined(_LEAST_PICTURES, steps))
    of_asset = max(cut_and_asset - cut, 0.0) / steps.cuts_per_view
    return pictures * (cut + of_asset)


class _Enough(Exception):
    """Raised when a trial has lasted long enough."""
