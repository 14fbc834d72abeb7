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
