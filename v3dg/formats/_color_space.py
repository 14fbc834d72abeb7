"""Converts linear colours of gaussians to sRGB, in which gaussians are blended."""

import numpy as np
from numpy.typing import NDArray

from v3dg import _core
from v3dg._numbers import Floats
from v3dg.gaussians import Gaussians

# Number of directions in which spherical harmonics are fitted to converted colours. It
# is several times the number of coefficients, 16.
_NUM_DIRECTIONS = 64
# Number of gaussians that are fitted together. Their colours fit into the cache.
_FITTED_AT_ONCE = 1 << 12


def conversion_note(name: str) -> str:
    """Return the sentence about the conversion from a linear colour space."""
    return (
        f"Colours are linear ({name}); they are converted to sRGB, in which they are then blended."
    )


def srgb_from_linear(gaussians: Gaussians) -> Gaussians:
    """Return the gaussians with their linear colours converted to sRGB. Spherical
    harmonics are fitted to the converted colours in directions over the whole
    sphere."""
    bases = _core.sh_bases(gaussians.sh_degree, _directions())
    inverse = np.linalg.pinv(bases)

    def encode(rows: slice) -> NDArray[np.float64]:
        colors = np.einsum("dk,nkc->ndc", bases, gaussians.sh[rows].astype(np.float64)) + 0.5
        encoded = _encoded(colors) - 0.5
        return np.asarray(np.einsum("kd,ndc->nkc", inverse, encoded))

    sh = np.empty_like(gaussians.sh)
    with np.errstate(invalid="ignore", over="ignore"):
        for start in range(0, len(gaussians), _FITTED_AT_ONCE):
            rows = slice(start, start + _FITTED_AT_ONCE)
            sh[rows] = encode(rows)
    converted = Gaussians(
        gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, sh
    )
    return converted.trained(antialiased=gaussians.antialiased)


def _directions() -> Floats:
    """Return (D, 3) evenly distributed unit vectors, which form a Fibonacci lattice."""
    steps = np.arange(_NUM_DIRECTIONS)
    z = 1 - (2 * steps + 1) / _NUM_DIRECTIONS
    angles = steps * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angles), radius * np.sin(angles), z], axis=1)


def _encoded(colors: Floats) -> Floats:
    """Return the sRGB values (IEC 61966-2-1) of linear colours. Negative colours become
    black."""
    light = np.maximum(colors, 0.0)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
