"""The different cuts of a selection, and their gaussians.

Instances of a bundle with equal cuts share one cut. Most instances of a large world are
far away and consist of one cluster each, so thousands of instances need few cuts. Cuts
are not changed, quantised or merged: the picture is that of the selection.
"""

from __future__ import annotations

import hashlib
import os
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

import v3dg

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt


class Cut(NamedTuple):
    """Clusters of a bundle, with the opacity and the tint of their instances.

    `digest` identifies the cut in data blocks of Blender. It depends on the file of the
    bundle, its size and modification time, the clusters, the opacity and the tint.
    """

    bundle: v3dg.Bundle
    cluster_ids: npt.NDArray[np.int32]
    opacity: float
    tint: tuple[float, float, float]
    num_gaussians: int
    digest: str


def distinct_cuts(selection: v3dg.Selection) -> dict[int, Cut]:
    """Return the cut of each instance that has one. Instances with equal cuts have the
    same object."""
    scene = selection.scene
    ids, first = np.unique(selection.instance_ids, return_index=True)
    ends = np.append(first, len(selection))[1:]
    sizes = [np.diff(bundle.clusters.offset) for bundle in scene.bundles]
    names = [_file_identity(bundle) for bundle in scene.bundles]
    cuts: dict[str, Cut] = {}
    result: dict[int, Cut] = {}
    for instance, start, end in zip(ids.tolist(), first.tolist(), ends.tolist(), strict=True):
        number = int(scene.instance_bundle[instance])
        clusters = selection.cluster_ids[start:end]
        opacity = float(scene.opacity[instance])
        red, green, blue = scene.tint[instance].tolist()
        appearance = f"{names[number]} {opacity!r} {red!r} {green!r} {blue!r} "
        digest = hashlib.blake2b(
            appearance.encode() + clusters.tobytes(), digest_size=16
        ).hexdigest()
        if digest not in cuts:
            cuts[digest] = Cut(
                bundle=scene.bundles[number],
                cluster_ids=clusters,
                opacity=opacity,
                tint=(red, green, blue),
                num_gaussians=int(sizes[number][clusters].sum()),
                digest=digest,
            )
        result[instance] = cuts[digest]
    return result


def _file_identity(bundle: v3dg.Bundle) -> str:
    """Return the path, size and modification time of a bundle's file."""
    assert bundle.path is not None
    status = os.stat(bundle.path)
    return f"{os.path.realpath(bundle.path)} {status.st_size} {status.st_mtime_ns}"


def gaussians_of(cuts: Sequence[Cut]) -> list[v3dg.Gaussians]:
    """Return the gaussians of cuts for an instance at the origin that stands upright,
    with z up. SH are rotated, and opacities and tints are applied."""
    result: dict[str, v3dg.Gaussians] = {}
    for bundle in dict.fromkeys(cut.bundle for cut in cuts):
        # All cuts of a bundle are gathered together, so they have the same SH degree.
        of_bundle = [cut for cut in cuts if cut.bundle is bundle]
        for cut, gaussians in zip(of_bundle, _gathered(bundle, of_bundle), strict=True):
            result[cut.digest] = gaussians
    return [result[cut.digest] for cut in cuts]


def _gathered(bundle: v3dg.Bundle, cuts: Sequence[Cut]) -> list[v3dg.Gaussians]:
    scene = v3dg.Scene()
    scene.add(
        bundle,
        np.zeros((len(cuts), 3)),
        opacity=[cut.opacity for cut in cuts],
        tint=[cut.tint for cut in cuts],
        up="z",
    )
    num_clusters = [len(cut.cluster_ids) for cut in cuts]
    num_gaussians = [cut.num_gaussians for cut in cuts]
    joined = v3dg.Selection(
        scene=scene,
        instance_ids=np.repeat(np.arange(len(cuts), dtype=np.int32), num_clusters),
        cluster_ids=np.concatenate([cut.cluster_ids for cut in cuts]),
        num_gaussians=sum(num_gaussians),
        tolerance=0.0,
        seconds=0.0,
    ).gaussians(device="cpu")
    ends = np.cumsum(num_gaussians)
    return [
        v3dg.Gaussians(
            means=joined.means[end - size : end],
            quats=joined.quats[end - size : end],
            scales=joined.scales[end - size : end],
            opacities=joined.opacities[end - size : end],
            sh=joined.sh[end - size : end],
        )
        for end, size in zip(ends.tolist(), num_gaussians, strict=True)
    ]
