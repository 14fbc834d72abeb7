"""The qualities of a build: whether, and for how long, it refines its levels
together."""

from dataclasses import dataclass
from typing import Literal, get_args

from v3dg._device import Device
from v3dg._json import JsonObject
from v3dg._numbers import one_of
from v3dg._progress import Progress
from v3dg.bundle import Bundle
from v3dg.gaussians import gaussian_bytes
from v3dg.levels.refined import DROP, record_of, refined_bundle

Quality = Literal["draft", "standard", "best"]

# Number of pictures of a "standard" refinement: at least the first number, plus one for
# every 50 gaussians, up to the last number. A large asset needs more because each
# picture shows a smaller part of it.
_LEAST_PICTURES = 20_000
_GAUSSIANS_PER_PICTURE = 50
_MOST_PICTURES = 100_000
# "best" uses this many times the pictures of "standard".
_BEST = 5
# A refinement needs memory for this many copies of all levels. All levels together have
# about twice as many gaussians as the asset.
_COPIES = 6


@dataclass(frozen=True)
class Refinement:
    """The refinement with which a build ends."""

    steps: int
    seed: int

    def refined(self, bundle: Bundle, device: Device, progress: Progress) -> Bundle:
        """Return the bundle with refined levels; level 0 is unchanged."""
        return refined_bundle(
            bundle, steps=self.steps, seed=self.seed, device=device, progress=progress
        )

    def settings_of(self, bundle: Bundle, settings: JsonObject) -> JsonObject:
        """Return the config of a bundle that was built with these settings and then
        refined."""
        if bundle.num_levels < 2:
            return settings
        return {**settings, "refined": record_of(self.steps, DROP, self.seed)}


def refinement_of(quality: Quality, num_gaussians: int, seed: int) -> Refinement | None:
    """Return the refinement for an asset of this many gaussians; None for a draft."""
    one_of(quality, "quality", get_args(Quality))
    if quality == "draft":
        return None
    steps = min(_LEAST_PICTURES + num_gaussians // _GAUSSIANS_PER_PICTURE, _MOST_PICTURES)
    if quality == "best":
        steps *= _BEST
    return Refinement(steps, seed)


def refine_bytes(quality: Quality, num_gaussians: int, sh_degree: int) -> int:
    """Return the host memory, in bytes, that the refinement of an asset needs."""
    if quality == "draft":
        return 0
    return 2 * _COPIES * num_gaussians * gaussian_bytes(sh_degree)
