"""Types of the compiled module."""

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Float32: TypeAlias = NDArray[np.float32]

has_cuda: bool

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

# cluster
def median_split(means: NDArray[Any], cluster_size: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]: ...
def bounding_ball_of_points(means: NDArray[Any], radii: NDArray[Any], offset: NDArray[Any]) -> Float32: ...
def bounding_ball_of_balls(balls: NDArray[Any], offset: NDArray[Any]) -> Float32: ...

# select
def num_cuda_devices() -> int: ...

class ClusterTable:
    def __init__(
        self,
        ball: NDArray[Any],
        weight: NDArray[Any],
        own_group: NDArray[Any],
        parent_group: NDArray[Any],
        box: NDArray[Any],
        filter_px2: NDArray[Any],
        offset: NDArray[Any],
    ) -> None: ...

def select(
    tables: list[ClusterTable],
    instance_bundle: NDArray[Any],
    positions: NDArray[Any],
    rotations: NDArray[Any],
    scales: NDArray[Any],
    viewmat: NDArray[Any],
    eye: NDArray[Any],
    K: NDArray[Any],
    width: float,
    height: float,
    near: float,
    tolerance: float,
    footprint: str,
    cull: bool,
    device: str,
) -> tuple[NDArray[np.int32], NDArray[np.int32], int]: ...
def group_metrics(
    tables: list[ClusterTable],
    instance_bundle: NDArray[Any],
    positions: NDArray[Any],
    rotations: NDArray[Any],
    scales: NDArray[Any],
    viewmat: NDArray[Any],
    eye: NDArray[Any],
    K: NDArray[Any],
    width: float,
    height: float,
    near: float,
    footprint: str,
) -> tuple[Float32, NDArray[np.int64]]: ...
