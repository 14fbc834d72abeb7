"""Real spherical harmonics up to degree 3, from their definition by Legendre
polynomials, in float64.

Order and signs are those of 3DGS files. Within degree l, the orders are m = -l..l, with
the Condon-Shortley phase.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.polynomial.legendre import Legendre


def basis(directions: np.ndarray, degree: int) -> np.ndarray:
    """Return (N,(degree+1)²) values of the basis for directions (N,3) of any length;
    for a zero direction, only degree 0 is not 0."""
    directions = np.asarray(directions, np.float64)
    length = np.linalg.norm(directions, axis=1, keepdims=True)
    x, y, z = (directions / np.where(length == 0, 1, length)).T
    columns = []
    for order_l in range(degree + 1):
        for m in range(-order_l, order_l + 1):
            k = abs(m)
            norm = (
                (2 * order_l + 1)
                / (4 * math.pi)
                * math.factorial(order_l - k)
                / math.factorial(order_l + k)
            )
            along_z = Legendre.basis(order_l).deriv(k)(z) if k else Legendre.basis(order_l)(z)
            around_z = (x + 1j * y) ** k  # sin^k(theta) (cos k phi + i sin k phi)
            around_z = around_z.imag if m < 0 else around_z.real
            columns.append((-1) ** k * math.sqrt(norm * (2 if k else 1)) * along_z * around_z)
    return np.stack(columns, axis=1)


def color(sh: np.ndarray, directions: np.ndarray, degree: int | None = None) -> np.ndarray:
    """Return (N,3) colours: the series of sh (N,K,3) up to the degree, plus one half,
    at least 0. Values that are not finite become 0.
    """
    sh = np.asarray(sh, np.float64)
    if degree is None:
        degree = math.isqrt(sh.shape[1]) - 1
    values = basis(directions, degree)
    with np.errstate(invalid="ignore"):
        series = np.einsum("nk,nkc->nc", values, sh[:, : values.shape[1]]) + 0.5
    return np.where(np.isfinite(series), np.maximum(0.0, series), 0.0)
