"""Types of the compiled module."""

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Float32: TypeAlias = NDArray[np.float32]

has_cuda: bool
reach_sigmas: float

def isa() -> str: ...
def ply_read(path: str) -> tuple[Float32, Float32, Float32, Float32, Float32]: ...
def ply_write(
    path: str,
    means: NDArray[Any],
    quats: NDArray[Any],
    scales: NDArray[Any],
    opacities: NDArray[Any],
    sh: NDArray[Any],
    encoding: str,
) -> None: ...

# box
def bound_by_boxes(
    means: NDArray[Any], quats: NDArray[Any], scales: NDArray[Any], offset: NDArray[Any]
) -> Float32: ...
def bound_by_boxes_cuda(
    means: Any, quats: Any, scales: Any, offset: NDArray[Any], box: Any, stream: int
) -> None: ...

# cluster
def num_halvings(count: int, cluster_size: int) -> int: ...
def median_split(
    means: NDArray[Any], offset: NDArray[Any], depth: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]: ...
def median_split_cuda(
    means: Any, offset: NDArray[Any], depth: int, order: Any, stream: int
) -> NDArray[np.int64]: ...
def bound_spheres(spheres: NDArray[Any], offset: NDArray[Any]) -> Float32: ...
def bound_spheres_cuda(spheres: Any, offset: NDArray[Any], ball: Any, stream: int) -> None: ...

# gather
def gather(
    bundles: list[tuple[Any, Any, Any, Any, Any]],
    bundle: NDArray[np.int32],
    positions: NDArray[np.float64],
    rotations: NDArray[np.float64],
    quaternions: NDArray[np.float64],
    scales: NDArray[np.float64],
    bands: NDArray[np.float64],
    instance: NDArray[np.int32],
    first_row: NDArray[np.int64],
    offset: NDArray[np.int64],
    num_bases: int,
) -> tuple[Float32, Float32, Float32, Float32, Float32]: ...
def gather_cuda(
    bundles: list[tuple[Any, Any, Any, Any, Any]],
    bundle: NDArray[np.int32],
    positions: NDArray[np.float64],
    rotations: NDArray[np.float64],
    quaternions: NDArray[np.float64],
    scales: NDArray[np.float64],
    bands: NDArray[np.float64],
    instance: NDArray[np.int32],
    first_row: NDArray[np.int64],
    offset: NDArray[np.int64],
    num_bases: int,
    rows: tuple[Any, Any, Any, Any, Any],
    stream: int,
) -> None: ...

# select
def num_cuda_devices() -> int: ...

class ClusterTable:
    def __init__(
        self,
        ball: NDArray[Any],
        weight: NDArray[Any],
        level: NDArray[Any],
        own_group: NDArray[Any],
        parent_group: NDArray[Any],
        box: NDArray[Any],
        filter_px2: NDArray[Any],
        offset: NDArray[Any],
    ) -> None: ...

# Instances are (bundle, positions, quaternions, scales, importance), a camera (viewmat, K, width, height,
# near, window or None), a rule (tolerance, budget or None, min_level, footprint, cull).
SelectedPairs: TypeAlias = tuple[NDArray[np.int32], NDArray[np.int32], int, float, bool]

def eye_of(viewmat: NDArray[np.float64]) -> NDArray[np.float64]: ...
def select(
    tables: list[ClusterTable], instances: tuple[Any, ...], camera: tuple[Any, ...], rule: tuple[Any, ...]
) -> SelectedPairs: ...
def group_metrics(
    tables: list[ClusterTable], instances: tuple[Any, ...], camera: tuple[Any, ...], rule: tuple[Any, ...]
) -> tuple[Float32, NDArray[np.int64]]: ...
def bounds_may_draw(
    tables: list[ClusterTable], instances: Instances, camera: Camera, rule: Rule, and_coarser: bool
) -> tuple[NDArray[np.uint8], NDArray[np.int64]]: ...

# render
class Model:
    """Gaussians laid out for the rasterizer."""

    def __init__(
        self,
        means: NDArray[Any],
        quats: NDArray[Any],
        scales: NDArray[Any],
        opacities: NDArray[Any],
        sh: NDArray[Any],
    ) -> None: ...
    def __len__(self) -> int: ...

class ModelDouble:
    """The same in double precision."""

    def __init__(
        self,
        means: NDArray[Any],
        quats: NDArray[Any],
        scales: NDArray[Any],
        opacities: NDArray[Any],
        sh: NDArray[Any],
    ) -> None: ...
    def __len__(self) -> int: ...

class Tape:
    """What rasterize leaves for rasterize_backward."""

class TapeDouble: ...

# The signature is the same in both precisions; arrays are of the model's.
def rasterize(
    model: Model | ModelDouble,
    view: Sequence[float] | NDArray[np.float64],
    filter_px2: float,
    compensate: bool,
    intrinsics: Sequence[float],
    width: int,
    height: int,
    background: Sequence[float],
    with_depth: bool,
    keep_tape: bool,
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any], Any]: ...
def rasterize_backward(
    tape: Tape | TapeDouble, d_color: NDArray[Any], d_alpha: NDArray[Any], d_depth: NDArray[Any] | None
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]: ...

class TapeCuda:
    """What rasterize_cuda leaves for rasterize_backward_cuda."""

# The picture (color, alpha, depth) is filled; the way back reads it and the gaussians again.
def rasterize_cuda(
    gaussians: tuple[Any, ...],
    view: Sequence[float] | NDArray[np.float64],
    filter_px2: float,
    compensate: bool,
    intrinsics: Sequence[float],
    background: Sequence[float],
    picture: tuple[Any, Any, Any],
    stream: int,
) -> TapeCuda: ...

# Fills d_gaussians, as (means, quats, scales, opacities, sh), and d_background.
def rasterize_backward_cuda(
    tape: TapeCuda,
    d_color: Any,
    d_alpha: Any,
    d_depth: Any | None,
    d_gaussians: tuple[Any, ...],
    d_background: Any,
    stream: int,
) -> None: ...

class Stop:
    """Asks, from any thread, for a picture under way to be given up: it is then left unfinished."""

    @property
    def is_requested(self) -> bool: ...
    def request(self) -> None: ...

def render_selection(
    bundles: list[tuple[Model, NDArray[np.int64], Float32, NDArray[np.uint8]]],
    instances: tuple[Any, ...],
    camera: tuple[Any, ...],
    instance_ids: NDArray[np.int32],
    cluster_ids: NDArray[np.int32],
    background: Sequence[float],
    with_depth: bool,
    stop: Stop | None = None,
) -> tuple[Float32, Float32, Float32, dict[str, Any]]: ...
def count_selection(
    bundles: list[tuple[Model, NDArray[np.int64], Float32, NDArray[np.uint8]]],
    instances: tuple[Any, ...],
    camera: tuple[Any, ...],
    instance_ids: NDArray[np.int32],
    cluster_ids: NDArray[np.int32],
    stop: Stop | None = None,
) -> tuple[Float32, dict[str, Any]]: ...
def pick_selection(
    bundles: list[tuple[Model, NDArray[np.int64], Float32, NDArray[np.uint8]]],
    instances: tuple[Any, ...],
    camera: tuple[Any, ...],
    instance_ids: NDArray[np.int32],
    cluster_ids: NDArray[np.int32],
) -> tuple[int, float, float] | None: ...

# frame, with CUDA only; arrays on the device are whatever has __cuda_array_interface__
class Drawing:
    """A frame that has been enqueued on a device."""

    def finish(self) -> dict[str, Any]: ...

class DeviceScene:
    """What selection reads of a scene, on a device. A bundle is (table, filter_px2, antialiased)."""

    def __init__(
        self, bundles: list[tuple[ClusterTable, Float32, NDArray[np.uint8]]], stream: int
    ) -> None: ...
    def set_instances(self, bundle: NDArray[np.int32], importance: Float32, stream: int) -> None: ...
    def set_poses(self, positions: Any, quaternions: Any, scales: Any, stream: int) -> None: ...
    def select(self, camera: tuple[Any, ...], rule: tuple[Any, ...], stream: int) -> SelectedPairs: ...

class SceneFrame:
    """Draws scenes of the same bundles; of each, its gaussians on the device."""

    def __init__(self, bundles: list[tuple[Any, ...]], stream: int) -> None: ...
    def draw(
        self,
        scene: DeviceScene,
        camera: tuple[Any, ...],
        rule: tuple[Any, ...],
        background: Sequence[float],
        picture: tuple[Any, Any, Any],
        stream: int,
    ) -> Drawing: ...
    def draw_cut(
        self,
        scene: DeviceScene,
        camera: tuple[Any, ...],
        instance_ids: Any,
        cluster_ids: Any,
        background: Sequence[float],
        picture: tuple[Any, Any, Any],
        stream: int,
    ) -> Drawing: ...

class ModelFrame:
    """Draws gaussians that stay on a device."""

    def __init__(self, gaussians: tuple[Any, ...], stream: int) -> None: ...
    def draw(
        self,
        view: Sequence[float] | NDArray[np.float64],
        filter_px2: float,
        compensate: bool,
        intrinsics: Sequence[float],
        background: Sequence[float],
        picture: tuple[Any, Any, Any],
        stream: int,
    ) -> Drawing: ...

# simplify
def prune(
    means: NDArray[Any],
    scales: NDArray[Any],
    opacities: NDArray[Any],
    in_offset: NDArray[np.int64],
    out_offset: NDArray[np.int64],
) -> NDArray[np.int64]: ...
def merge(
    means: NDArray[Any],
    quats: NDArray[Any],
    scales: NDArray[Any],
    opacities: NDArray[Any],
    sh: NDArray[Any],
    in_offset: NDArray[np.int64],
    out_offset: NDArray[np.int64],
) -> tuple[Float32, Float32, Float32, Float32, Float32]: ...
def prune_cuda(
    means: Any,
    scales: Any,
    opacities: Any,
    in_offset: NDArray[np.int64],
    out_offset: NDArray[np.int64],
    kept: Any,
    stream: int,
) -> None: ...
def merge_cuda(
    means: Any,
    quats: Any,
    scales: Any,
    opacities: Any,
    sh: Any,
    in_offset: NDArray[np.int64],
    out_offset: NDArray[np.int64],
    out_means: Any,
    out_quats: Any,
    out_scales: Any,
    out_opacities: Any,
    out_sh: Any,
    stream: int,
) -> None: ...

# fit_level
class LossWeights:
    def __init__(self, l1: float, dssim: float, alpha: float) -> None: ...

class FitConfig:
    steps: int
    views_per_step: int
    num_views: int
    supersample: int
    image_size: int
    px2_per_gaussian: float
    distance: float
    filter_px2: float
    compensate: bool
    loss: LossWeights
    step_position: float
    step_log_scale: float
    step_quat: float
    step_logit: float
    step_sh0: float
    step_sh_rest: float
    position_in_world: bool
    final_step: float
    seed: int

class FitProgress:
    """How far fit_level has come; shared with the thread that waits for it."""

    @property
    def groups_done(self) -> int: ...
    @property
    def loss_sum(self) -> float: ...
    def cancel(self) -> None: ...

# Writes the result over the start (means, ..., sh), and the residuals into `error`.
def fit_level(
    config: FitConfig,
    target: Model,
    target_filter_px2: float,
    target_compensate: bool,
    target_range: NDArray[np.int64],
    range: NDArray[np.int64],
    ball: Float32,
    stream: NDArray[np.int64],
    means: Float32,
    quats: Float32,
    scales: Float32,
    opacities: Float32,
    sh: Float32,
    error: Float32,
    progress: FitProgress,
) -> None: ...
def fit_level_cuda(
    config: FitConfig,
    target_means: Any,
    target_quats: Any,
    target_scales: Any,
    target_opacities: Any,
    target_sh: Any,
    target_filter_px2: float,
    target_compensate: bool,
    target_range: NDArray[Any],
    range: NDArray[Any],
    ball: NDArray[Any],
    stream: NDArray[Any],
    means: Any,
    quats: Any,
    scales: Any,
    opacities: Any,
    sh: Any,
    error: NDArray[Any],
    progress: FitProgress,
    cuda_stream: int,
) -> None: ...

# loss
def dssim(picture: Float32, target: Float32) -> tuple[float, Float32]: ...
