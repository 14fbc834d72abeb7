"""Lighting of generated assets: a sun, a sky and the ground's reflection, stored as
spherical harmonics.

Shadows are computed from the gaussians. For each of a few directions, the light that
gaussians block is summed in the cells of a grid. Sums along the direction then give the
light that arrives at each gaussian.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from benchmarks.worlds.procedural._parts import UP, Array, Part, quaternions, unit
from v3dg import _core
from v3dg.gaussians import Gaussians

SH_C0 = _core.sh_base0  # value of the constant spherical harmonic
SH_C1 = 0.4886025119029199  # factor of the linear spherical harmonics
TO_SUN = np.array([0.42, -0.50, 0.76]) / np.linalg.norm([0.42, -0.50, 0.76])
SUN = np.array([1.55, 1.42, 1.18])
SKY = np.array([0.42, 0.52, 0.62])
# Number of grid cells; enough for shadows of leaves, few enough for speed.
_CELLS = 1.2e6
_LOBE = 0.30  # width of a highlight; a narrower one would cause ringing at degree 3


def sh_basis(directions: Array, degree: int) -> Array:
    """Evaluate the real spherical harmonics of 3DGS at unit directions (n,3); return
    (n, (degree+1)²)."""
    x, y, z = directions.T
    columns = [np.full(len(directions), SH_C0)]
    if degree >= 1:
        columns += [-SH_C1 * y, SH_C1 * z, -SH_C1 * x]
    if degree >= 2:
        c, c0, c2 = (
            math.sqrt(15 / (4 * math.pi)),
            math.sqrt(5 / (16 * math.pi)),
            math.sqrt(15 / (16 * math.pi)),
        )
        columns += [c * x * y, -c * y * z, c0 * (3 * z * z - 1), -c * x * z, c2 * (x * x - y * y)]
    if degree >= 3:
        c1, c2, c3 = (math.sqrt(k / math.pi) for k in (21 / 32, 105 / 16, 35 / 32))
        c0 = math.sqrt(7 / (16 * math.pi))
        columns += [
            -c3 * y * (3 * x * x - y * y),
            2 * c2 * x * y * z,
            -c1 * y * (5 * z * z - 1),
            c0 * z * (5 * z * z - 3),
            -c1 * x * (5 * z * z - 1),
            c2 * z * (x * x - y * y),
            -c3 * x * (x * x - 3 * y * y),
        ]
    return np.stack(columns, -1)


def display(linear: Array) -> Array:
    """Convert linear light to display values, and compress highlights."""
    rolled = linear * (1 + linear / 6.0) / (1 + 0.55 * linear)
    return np.clip(rolled, 0, None) ** (1 / 2.2)


def _arriving(part: Part, directions: Array, rng: np.random.Generator) -> Array:
    """Return the fraction of light from each of D directions that arrives at each
    gaussian, (D,n)."""
    # The area that a gaussian shades. Its two longest axes determine the area, whatever
    # the direction of the light.
    stops = np.pi * part.scales[:, 0] * part.scales[:, 1] * part.opacities
    means = part.means.astype(np.float32)
    sides = np.ptp(means, axis=0).astype(np.float64)
    cell = max(float(np.prod(sides) / _CELLS) ** (1 / 3), float(sides.max()) / 256)
    # Opaque gaussians are evaluated above their surface; otherwise they would shade
    # themselves.
    lift = part.normals * (1.5 * (1 - part.translucency))[:, None] + rng.uniform(
        -0.4, 0.4, means.shape
    )
    lifted = means + np.float32(cell) * lift.astype(np.float32)
    result = np.empty((len(directions), len(means)))
    for row, toward in zip(result, directions, strict=True):
        side = unit(np.cross(toward, [0.3, 0.9, 0.1]))
        frame = np.float32(np.stack([side, np.cross(toward, side), toward]) / cell)
        place, look = (np.stack([points @ axis for axis in frame]) for points in (means, lifted))
        first = place.min(axis=1) - 2
        shape = np.ceil(place.max(axis=1) - first).astype(np.int32) + 3
        look[2] += 2
        cells = [
            np.clip((p - first[:, None]).astype(np.int32), 0, shape[:, None] - 1)
            for p in (place, look)
        ]
        at, seen = ((c[0] * shape[1] + c[1]) * shape[2] + c[2] for c in cells)
        depth = np.bincount(at, stops, int(np.prod(shape))).astype(np.float32).reshape(
            shape
        ) / np.float32(cell**2)
        for axis in (0, 1):  # softens the edges of shadows
            depth = 0.5 * depth + 0.25 * (np.roll(depth, 1, axis) + np.roll(depth, -1, axis))
        above = np.exp(-np.cumsum(depth[:, :, ::-1], axis=2)[:, :, ::-1])
        row[:] = above.ravel()[seen]
    return result


def _sky_directions() -> Array:
    """Return six directions on the upper hemisphere that contribute equally."""
    azimuth = np.arange(5) * (2 * np.pi / 5) + 0.4
    height = np.where(np.arange(5) % 2, 0.45, 0.75)
    flat = np.sqrt(1 - height**2)
    return np.concatenate(
        [[UP], np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), height], -1)]
    )


def light(part: Part, degree: int, rng: np.random.Generator, *, even: float = 0.0) -> Array:
    """Compute the light on gaussians that shade each other; return their colours as
    spherical harmonics.

    Args:
        even: Fraction of the light that comes equally from all directions, for assets
            that will be placed in any orientation.

    Returns:
        (n, (degree+1)², 3) coefficients. Above degree 0 they contain highlights and sky
        reflections of glossy parts, light through translucent parts, and some noise, as
        after training.
    """
    n, thin = part.normals, part.translucency
    directions = _sky_directions()
    arriving = _arriving(part, np.concatenate([[TO_SUN], directions]), rng)
    sunlit = arriving[0]
    facing = n @ TO_SUN
    sky = np.zeros(len(n))
    for share, toward in zip(arriving[1:], directions, strict=True):
        cosine = n @ toward
        sky += share * ((1 - thin) * np.maximum(cosine, 0) + thin * (0.35 + 0.3 * np.abs(cosine)))
    sky = (0.10 + 2 / len(directions) * sky) * part.occlusion
    direct = sunlit * ((1 - thin) * np.maximum(facing, 0) + thin * (0.40 + 0.50 * np.abs(facing)))
    bounce = (
        np.array([0.11, 0.12, 0.07])
        * ((1 - n[:, 2]) * part.occlusion * (0.3 + 0.7 * arriving[1]))[:, None]
    )
    lit = (1 - even) * (
        direct[:, None] * SUN + sky[:, None] * SKY + bounce
    ) + even * part.occlusion[:, None]
    linear = part.albedo * lit
    colour = display(linear)

    # The colour seen by an eye in direction v is a sum of lobes around directions. The
    # lobe around r has the coefficients w_l Y_lm(r) of a smoothed point. They are
    # scaled such that the lobe's peak is 1 above its mean. Y is evaluated at the
    # direction from the eye, which is -v.
    bands = np.repeat(np.arange(degree + 1), 2 * np.arange(degree + 1) + 1)
    smooth = np.exp(-0.5 * _LOBE**2 * bands * (bands + 1))

    sh = np.zeros((len(n), len(bands), 3))
    sh[:, 0] = (colour - 0.5) / SH_C0
    if degree == 0:
        return sh
    top = smooth[1:].sum() / (4 * np.pi)

    def add(rows: NDArray[np.int64], around: Array, strength: Array) -> None:
        """Add lobes of ``strength`` (m,3) around unit directions (m,3) to some
        gaussians. The mean colour does not change."""
        coefficients = smooth[1:] / top * sh_basis(-around, degree)[:, 1:]
        sh[rows, 1:] += coefficients[:, :, None] * strength[:, None, :]

    shiny = np.flatnonzero(part.gloss > 0)
    if len(shiny):
        m, struck = n[shiny], sunlit[shiny] * np.clip(3 * facing[shiny], 0, 1)
        mirrored_sun = unit(2 * facing[shiny, None] * m - TO_SUN)
        mirrored_sky = unit(2 * m[:, 2:] * m - UP)
        gloss = part.gloss[shiny]
        add(shiny, mirrored_sun, (0.5 * gloss * struck)[:, None] * np.array([1.0, 0.97, 0.9]))
        add(shiny, mirrored_sky, (0.12 * gloss * sky[shiny])[:, None] * np.array([0.9, 0.97, 1.0]))
    through = np.flatnonzero(thin > 0)
    if len(through):
        glow = 0.30 * (thin * sunlit)[through, None] * colour[through]
        add(through, np.broadcast_to(-TO_SUN, (len(through), 3)), glow * np.array([1.05, 1.0, 0.6]))
    sh[:, 1:] += 0.02 * rng.standard_normal((len(n), len(bands) - 1, 1))
    return sh


def gaussians_of(
    part: Part, degree: int, rng: np.random.Generator, *, even: float = 0.0
) -> Gaussians:
    """Compute the light on a part; return its gaussians in random order.

    Files of trained assets have no order, either.
    """
    order = rng.permutation(len(part.means))
    sh = light(part, degree, rng, even=even)
    quats = quaternions(part.tangents, part.normals)
    rows = (part.means, quats, part.scales, part.opacities, sh)
    return Gaussians(*(np.ascontiguousarray(row[order], dtype=np.float32) for row in rows))
