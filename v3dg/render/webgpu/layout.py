"""The inputs of project.wgsl: where the codes of each cluster are in the pool, how
instances stand in front of the camera, and the camera.

Computed in double precision and then rounded, as csrc/math/similarity.h and view.h do.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from v3dg import _core
from v3dg.rotations import rotation_from_quaternion

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from v3dg.bundle.pages import PageLayout
    from v3dg.bundle.tables import Clusters
    from v3dg.cameras import Camera
    from v3dg.scene import Scene

GAUSSIANS_OF_WORKGROUP = 256
WORDS_OF_RECORD = 4
_WORDS_OF_RANGES = (10, 12, 13, 15)  # by SH degree
_ANTIALIASED = 1
_LIMITED = 2
_DEGREE_SHIFT = 4
# Slopes are clamped this far outside of the picture, in halves of the field of view.
_FOV_MARGIN = 0.3

# Pair of project.wgsl.
_PAIR = np.dtype(
    [
        ("placement", np.uint32),
        ("end", np.uint32),
        ("record_word", np.uint32),
        ("sh_word", np.uint32),
        ("range_word", np.uint32),
        ("filter_px2", np.float32),
        ("look", np.uint32),
        ("weight", np.float32),
    ]
)


@dataclass(frozen=True, eq=False)
class ClusterCodes:
    """Where the codes of C clusters are, in words from the beginning of their page.

    Attributes:
        page: (C,) index of the cluster's page.
        num_gaussians: (C,) number of gaussians.
        record_word, sh_word, range_word: (C,) first words of the records, of the codes
            of spherical harmonics, and of the ranges.
        clusters: The table of the clusters.
        sh_degree: SH degree of all gaussians.
    """

    page: NDArray[np.int64]
    num_gaussians: NDArray[np.int64]
    record_word: NDArray[np.int64]
    sh_word: NDArray[np.int64]
    range_word: NDArray[np.int64]
    clusters: Clusters
    sh_degree: int

    @staticmethod
    def of(clusters: Clusters, layout: PageLayout, sh_degree: int) -> ClusterCodes:
        """Return the places of the codes of a bundle's clusters."""
        first_cluster = layout.first_cluster
        page = np.repeat(np.arange(layout.num_pages), np.diff(first_cluster))
        page_rows = np.diff(layout.first_gaussian)[page]
        row = clusters.offset[:-1] - layout.first_gaussian[page]
        number = np.arange(len(clusters)) - first_cluster[page]
        sh_words = 2 * sh_degree
        ranges = (WORDS_OF_RECORD + sh_words) * page_rows + _WORDS_OF_RANGES[sh_degree] * number
        return ClusterCodes(
            page=page,
            num_gaussians=np.diff(clusters.offset),
            record_word=WORDS_OF_RECORD * row,
            sh_word=WORDS_OF_RECORD * page_rows + sh_words * row,
            range_word=ranges,
            clusters=clusters,
            sh_degree=sh_degree,
        )


@dataclass(frozen=True, eq=False)
class Cut:
    """A cut in the layout of project.wgsl.

    Attributes:
        num_gaussians: Number of gaussians.
        pairs: (S,) clusters and instances.
        first_pairs: Pair of the first gaussian of each workgroup.
        instances: (I,) instances to which `placement` of the pairs refers.
    """

    num_gaussians: int
    pairs: NDArray[np.void]
    first_pairs: NDArray[np.uint32]
    instances: NDArray[np.int32]


def lay_out(
    scene: Scene,
    instance_ids: NDArray[np.int32],
    cluster_ids: NDArray[np.int32],
    weights: NDArray[np.float32] | None,
    codes: Sequence[ClusterCodes],
    first_words: Sequence[NDArray[np.int64]],
) -> Cut:
    """Return a selection in the layout of project.wgsl.

    Args:
        scene: The scene of the selection.
        instance_ids, cluster_ids, weights: As in `v3dg.Selection`.
        codes: The clusters of each bundle.
        first_words: First word of each page in the pool, for each bundle. All pages of
            the selection are in the pool.
    """
    pairs = np.zeros(len(instance_ids), _PAIR)
    counts = np.zeros(len(instance_ids), np.int64)
    bundle_from_pair = scene.instance_bundle[instance_ids]
    for number, table in enumerate(codes):
        rows = np.flatnonzero(bundle_from_pair == number)
        ids = cluster_ids[rows]
        first_word = first_words[number][table.page[ids]]
        counts[rows] = table.num_gaussians[ids]
        pairs["record_word"][rows] = first_word + table.record_word[ids]
        pairs["sh_word"][rows] = first_word + table.sh_word[ids]
        pairs["range_word"][rows] = first_word + table.range_word[ids]
        filter_px2, look = _looks(table, ids, fades=weights is not None)
        pairs["filter_px2"][rows] = filter_px2
        pairs["look"][rows] = look
    ends = np.cumsum(counts)
    num_gaussians = int(counts.sum())
    instances, placement = np.unique(instance_ids, return_inverse=True)
    pairs["placement"] = placement
    pairs["end"] = ends
    pairs["weight"] = 1
    if weights is not None:
        pairs["weight"] = weights
    factors = scene.factors
    if factors is not None:
        pairs["weight"] *= factors[instance_ids, 3]
    starts = np.arange(0, num_gaussians, GAUSSIANS_OF_WORKGROUP)
    first_pairs = np.searchsorted(ends, starts, side="right").astype(np.uint32)
    return Cut(num_gaussians, pairs, first_pairs, instances)


def _looks(
    table: ClusterCodes, ids: NDArray[np.int32], *, fades: bool
) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Return the filter of each cluster, px², and its `look`."""
    clusters = table.clusters
    filter_px2 = clusters.filter_px2[ids]
    is_limited = np.zeros(len(ids), np.bool_)
    if fades:
        is_limited = (clusters.own_group[ids] < 0) & (filter_px2 == 0)
    is_antialiased = is_limited | (clusters.antialiased[ids] > 0)
    look = _ANTIALIASED * is_antialiased + _LIMITED * is_limited
    look = look + (table.sh_degree << _DEGREE_SHIFT)
    limited = np.where(is_limited, np.float32(_core.fade_filter_px2), filter_px2)
    return limited, look.astype(np.uint32)


def placements_of(
    camera: Camera, scene: Scene, instances: NDArray[np.int32]
) -> NDArray[np.float32]:
    """Return (I, 24) the placements of instances in front of a camera."""
    viewmat = np.asarray(camera.viewmat, np.float64)
    scales = np.asarray(scene.scales, np.float64)[instances]
    rotations = rotation_from_quaternion(scene.quaternions[instances])
    from_origin = camera.position - np.asarray(scene.positions, np.float64)[instances]
    eyes = np.einsum("nka,nk->na", rotations, from_origin) / scales[:, None]
    leading = eyes.astype(np.float32)
    linear = scales[:, None, None] * (viewmat[:3, :3] @ rotations)
    translation = np.einsum("nrk,nk->nr", linear, leading.astype(np.float64))
    translation -= from_origin @ viewmat[:3, :3].T
    out = np.zeros((len(instances), 24), np.float32)
    rows = out[:, :12].reshape(-1, 3, 4)
    rows[:, :, :3] = linear
    rows[:, :, 3] = translation
    out[:, 12:15] = leading
    out[:, 16:19] = eyes - leading
    out[:, 20:23] = 1
    factors = scene.factors
    if factors is not None:
        out[:, 20:23] = factors[instances, :3]
    return out


def camera_block(
    camera: Camera, num_gaussians: int, min_transmittance: float
) -> NDArray[np.float32]:
    """Return the camera in the layout of shared.wgsl. Its background is black."""
    k = np.asarray(camera.K, np.float64)
    focal = np.array([k[0, 0], k[1, 1]])
    center = k[:2, 2]
    size = np.array([camera.width, camera.height])
    margin = _FOV_MARGIN * size / (2 * focal)
    block = np.zeros(16, np.float32)
    block[0:2] = focal
    block[2:4] = center
    block[4:6] = size
    block[6] = camera.near
    block[7:8].view(np.uint32)[:] = num_gaussians
    block[8:10] = -(center / focal + margin)
    block[10:12] = (size - center) / focal + margin
    block[15] = min_transmittance
    return block
