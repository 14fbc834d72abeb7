"""Computes the channels of a sensor in float64, with and without meshes. Blends every
gaussian in every pixel, front to back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from reference import sh as reference_sh
from reference.project import project, rotation
from reference.rasterize import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN


@dataclass(frozen=True)
class Mesh:
    color: np.ndarray  # (H,W,3)
    depth: np.ndarray  # (H,W)
    coverage: np.ndarray  # (H,W)
    normal: np.ndarray  # (H,W,3) unit length or 0


@dataclass(frozen=True)
class Sensed:
    color: np.ndarray  # (H,W,3)
    alpha: np.ndarray  # (H,W)
    depth: np.ndarray  # (H,W)
    median_depth: np.ndarray  # (H,W)
    normal: np.ndarray  # (H,W,3)
    normal_length: np.ndarray  # (H,W) length of the normal before it is normalised
    # (H,W) index of the gaussian with the largest weight; -1 for none, -2 for the mesh
    strongest: np.ndarray
    weight: np.ndarray  # (H,W) largest weight
    second_weight: np.ndarray  # (H,W) second largest weight
    # (H,W) smallest relative distance of a transmittance from a half or from the stop
    # limit, or of an alpha from the cut-off. If it is small, rounding decides.
    margin: np.ndarray


def normals(gaussians, camera):
    """Return the normals (N,3) in view space: the shortest axes, facing the eye."""
    axes = rotation(gaussians.quats)
    shortest = np.argmin(np.asarray(gaussians.scales, np.float64), axis=1)
    axis = axes[np.arange(len(shortest)), :, shortest] @ camera.viewmat[:3, :3].T
    view = np.asarray(gaussians.means, np.float64) @ camera.viewmat[:3, :3].T
    view = view + camera.viewmat[:3, 3]
    return np.where((axis * view).sum(1, keepdims=True) > 0, -axis, axis)


def linear(x):
    y = np.abs(x)
    y = np.where(y <= 0.04045, y / 12.92, ((y + 0.055) / 1.055) ** 2.4)
    return np.copysign(y, x)


def display(x):
    y = np.abs(x)
    y = np.where(y <= 0.0031308, y * 12.92, 1.055 * y ** (1 / 2.4) - 0.055)
    return np.copysign(y, x)


@dataclass(frozen=True)
class Blended:
    """The blended gaussians of a pixel without a mesh, front to back."""

    weights: np.ndarray  # (N,) weights, not yet multiplied by the gain
    left: np.ndarray  # (N,) transmittance behind each gaussian
    stopped: int  # index of the gaussian at which the pixel stopped; N if it did not
    end: float  # transmittance behind all gaussians
    gain: float  # factor that makes the sum of the weights 1 after a stop
    margin: float  # smallest relative distance of a transmittance from the stop limit


def blended(alphas, stop, fills) -> Blended:
    """Blend the gaussians of a pixel until a transmittance is at most `stop`. If
    `fills` is true, the last gaussian is included and the weights are scaled to a sum
    of 1; otherwise the last gaussian is left out."""
    weights, left = np.zeros(len(alphas)), np.zeros(len(alphas))
    transmittance, stopped, margin = 1.0, len(alphas), np.inf
    for i, alpha in enumerate(alphas):
        behind = transmittance * (1 - alpha)
        if alpha > 0 and stop > 0:
            margin = min(margin, abs(behind / stop - 1))
        stops = alpha > 0 and behind <= stop
        if not stops or fills:
            weights[i] = transmittance * alpha
            transmittance = behind
        left[i] = transmittance
        if stops:
            stopped = i
            break
    left[stopped:] = 0.0 if fills else transmittance
    if fills and stopped < len(alphas):
        return Blended(weights, left, stopped, 0.0, 1 / (1 - transmittance), margin)
    return Blended(weights, left, stopped, transmittance, 1.0, margin)


def sense(
    gaussians, camera, *, mesh=None, background=(0, 0, 0), min_transmittance=None, light="display"
) -> Sensed:
    """Draw an asset, without a low-pass filter."""
    stop = TRANSMITTANCE_MIN if min_transmittance is None else min_transmittance
    projection = project(gaussians, camera)
    colors = reference_sh.color(gaussians.sh, np.asarray(gaussians.means) - camera.position, None)
    order = np.argsort(projection.depth, kind="stable")
    order = order[projection.is_drawable[order]]
    depths, colors = projection.depth[order], colors[order]
    normal_of = normals(gaussians, camera)[order]
    shape = (camera.height, camera.width)
    planes = ("alpha", "depth", "median_depth", "normal_length", "weight", "second_weight")
    out = {name: np.zeros(shape) for name in planes}
    out |= {name: np.zeros((*shape, 3)) for name in ("color", "normal")}
    out |= {"strongest": np.full(shape, -1), "margin": np.full(shape, np.inf)}
    for y, x in np.ndindex(shape):
        alphas, margin = _alphas(gaussians, projection, order, x + 0.5, y + 0.5)
        pixel = blended(alphas, stop, min_transmittance is not None)
        coverage, at, mesh_normal, mesh_color = 0.0, np.inf, np.zeros(3), np.zeros(3)
        if mesh is not None and mesh.coverage[y, x] > 0:
            coverage, at = float(mesh.coverage[y, x]), float(mesh.depth[y, x])
            mesh_normal, mesh_color = mesh.normal[y, x], mesh.color[y, x]
        front = int((depths < at).sum())
        # the pixel stopped in front of the mesh, which is therefore hidden
        if pixel.stopped < front:
            coverage = 0.0
        passed = pixel.left[front - 1] if front > 0 else 1.0
        share = np.full(len(depths), (1 - coverage) * pixel.gain)
        share[:front] += coverage
        weights = share * pixel.weights
        of_mesh = coverage * passed

        plain = pixel.gain * pixel.weights @ colors + pixel.end * np.asarray(background)
        in_front = pixel.weights[:front] @ colors[:front]
        out["color"][y, x] = _mixed(plain, in_front, mesh_color, coverage, passed, light)
        alpha = (1 - coverage) * (1 - pixel.end) + coverage
        out["alpha"][y, x] = alpha
        of_depth = weights @ depths + (of_mesh * at if of_mesh > 0 else 0.0)
        out["depth"][y, x] = of_depth / alpha if alpha > 0 else 0.0
        normal = weights @ normal_of + of_mesh * mesh_normal
        length = np.linalg.norm(normal)
        out["normal_length"][y, x] = length
        out["normal"][y, x] = normal / length if length > 0 else 0.0

        layers = np.insert(depths, front, at)
        left = np.insert(pixel.left, front, passed)
        left[front:] *= 1 - coverage
        is_dark = np.flatnonzero(left <= 0.5)
        if len(is_dark):
            out["median_depth"][y, x] = layers[is_dark[0]]
        ranked = np.insert(weights, front, of_mesh)
        names = np.insert(order, front, -2)
        best = int(np.argmax(ranked))  # the first one of equal values
        if ranked[best] > 0:
            out["strongest"][y, x] = names[best]
            out["weight"][y, x] = ranked[best]
        out["second_weight"][y, x] = np.sort(ranked)[-2] if len(ranked) > 1 else 0.0
        near_half = np.abs(left - 0.5).min()
        out["margin"][y, x] = min(margin, pixel.margin, near_half)
    return Sensed(**out)


def _alphas(gaussians, projection, order, x, y):
    """Return the alphas (N,) in a pixel, and the smallest relative distance of one of
    them from the cut-off."""
    a = projection.covariance_px2[order, 0, 0]
    b = projection.covariance_px2[order, 0, 1]
    dx = x - projection.mean_px[order, 0]
    dy = y - projection.mean_px[order, 1]
    exponent = dx * dx / a + (a * dy - b * dx) ** 2 / (a * projection.determinant[order])
    falloff = np.asarray(gaussians.opacities, np.float64)[order] * np.exp(-0.5 * exponent)
    margin = float(np.abs(falloff / ALPHA_MIN - 1).min(initial=np.inf))
    return np.where(falloff >= ALPHA_MIN, np.minimum(falloff, ALPHA_MAX), 0.0), margin


def _mixed(plain, front, mesh_color, coverage, passed, light):
    """Return the mixture of `coverage` parts of a pixel in which the mesh hides the
    gaussians behind it, and 1 - `coverage` parts of the pixel without the mesh."""
    if coverage == 0:
        return plain
    if light == "display":
        return (1 - coverage) * plain + coverage * (front + passed * mesh_color)
    opacity = 1 - passed
    straight = front / opacity if opacity > 0 else np.zeros(3)
    hidden = opacity * linear(straight) + passed * mesh_color
    return display((1 - coverage) * linear(plain) + coverage * hidden)


def clipped(gaussians, camera):
    """Return (H,W) whether the ray of a pixel, beyond the near plane, meets the body of
    a gaussian whose centre is before that plane. Also return the smallest relative
    distance of an alpha from the limit of bodies."""
    to_view, origin = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    view = np.asarray(gaussians.means, np.float64) @ to_view.T + origin
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack(
        [(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1
    )
    found = np.zeros(x.shape, bool)
    margin = np.full(x.shape, np.inf)
    axes = to_view @ rotation(gaussians.quats)
    for i in np.flatnonzero(view[:, 2] < camera.near):
        inverse = axes[i].T / np.asarray(gaussians.scales, np.float64)[i][:, None]
        a, b = rays @ inverse.T, inverse @ view[i]
        depth = np.maximum((a @ b) / (a * a).sum(-1), camera.near)
        distance2 = ((depth[..., None] * a - b) ** 2).sum(-1)
        alpha = float(gaussians.opacities[i]) * np.exp(-0.5 * distance2)
        found |= alpha >= ALPHA_MIN
        margin = np.minimum(margin, np.abs(alpha / ALPHA_MIN - 1))
    return found, margin
