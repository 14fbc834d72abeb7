"""The qualities of a build: whether, and for how long, it refines its levels
together."""

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

from v3dg._device import Device
from v3dg._json import JsonObject
from v3dg._numbers import check, one_of
from v3dg._progress import Progress
from v3dg.bundle import Bundle
from v3dg.gaussians import gaussian_bytes
from v3dg.levels.refined import DROP, Cuts, default_steps, record_of, refined_bundle
from v3dg.levels.viewpoints import RECORDED, SeenFrom

Quality = Literal["draft", "standard", "best"]

# Number of pictures of a "standard" refinement: at least the first number, plus one for
# every 100 gaussians, up to the last number. A large asset needs more because each
# picture shows a smaller part of it.
_LEAST_PICTURES = 18_000
_GAUSSIANS_PER_PICTURE = 100
_MOST_PICTURES = 100_000
# "best" uses this many times the pictures of "standard".
_BEST = 5
# A refinement needs memory for this many copies of all levels. All levels together have
# about twice as many gaussians as the asset.
_COPIES = 6
# The time for which each of two kinds of pictures is measured, for an estimate.
_SECONDS_OF_TRIAL = 0.25


@dataclass(frozen=True)
class Refinement:
    """The refinement with which a build ends."""

    steps: int
    seed: int
    seen_from: SeenFrom = "auto"

    def refined(self, bundle: Bundle, device: Device, progress: Progress) -> Bundle:
        """Return the bundle with refined levels; level 0 is unchanged."""
        return refined_bundle(
            bundle,
            seen_from=self.seen_from,
            steps=self.steps,
            seed=self.seed,
            device=device,
            progress=progress,
        )

    def settings_of(self, bundle: Bundle, settings: JsonObject) -> JsonObject:
        """Return the config of a bundle that was built with these settings and then
        refined. The eyes, which follow from its gaussians, are those that it has."""
        if bundle.num_levels < 2:
            return settings
        record = record_of(self.steps, DROP, self.seed, self.seen_from)
        record_of_bundle = bundle.config.get("refined")
        if isinstance(record_of_bundle, dict):
            record |= {n: record_of_bundle[n] for n in RECORDED if n in record_of_bundle}
        return {**settings, "refined": record}


def refinement_of(
    quality: Quality, num_gaussians: int, seed: int, seen_from: SeenFrom = "auto"
) -> Refinement | None:
    """Return the refinement for an asset of this many gaussians; None for a draft."""
    one_of(quality, "quality", get_args(Quality))
    one_of(seen_from, "seen_from", get_args(SeenFrom))
    if quality == "draft":
        check(
            "seen_from",
            seen_from == "auto",
            f"auto for levels that are not refined, got {seen_from}; name the quality standard",
        )
        return None
    return Refinement(pictures_of(quality, num_gaussians), seed, seen_from)


def pictures_of(quality: Literal["standard", "best"], num_gaussians: int) -> int:
    """The number of pictures by which an asset of this many gaussians is refined."""
    pictures = min(_LEAST_PICTURES + num_gaussians // _GAUSSIANS_PER_PICTURE, _MOST_PICTURES)
    if quality == "best":
        pictures *= _BEST
    return pictures


def refine_bytes(quality: Quality, num_gaussians: int, sh_degree: int) -> int:
    """Return the memory, in bytes, that the refinement of an asset needs: of the host,
    and as much of a GPU."""
    if quality == "draft":
        return 0
    return 2 * _COPIES * num_gaussians * gaussian_bytes(sh_degree)


def estimated_seconds(bundle: Bundle, device: Device) -> float:
    """Return about how long a standard refinement of a bundle takes on a device, from
    the first pictures of one."""
    num_leaves = int(bundle.clusters.offset[bundle.level_range(0).stop])
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

    # The first pictures of a refinement each draw the asset, too, which most others do
    # not; those that weigh gaussians do not draw it.
    cut = trial(lambda cuts: cuts.weights(_LEAST_PICTURES))
    cut_and_asset = trial(lambda cuts: cuts.refined(_LEAST_PICTURES, steps))
    of_asset = max(cut_and_asset - cut, 0.0) / steps.cuts_per_view
    return pictures_of("standard", num_leaves) * (cut + of_asset)


class _Enough(Exception):
    """Raised when a trial has lasted long enough."""
