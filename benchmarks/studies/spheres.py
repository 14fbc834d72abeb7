"""The error of equirectangular pictures relative to rays in float64.

    python -m benchmarks.studies.spheres

There are three ways to draw such a picture: the projection of each gaussian, linearised
in longitude and latitude (EWA, in float64, with seams drawn on both sides); the 26
pinhole pictures of `v3dg.draw_panorama`; and the rays of `v3dg.EquirectangularCamera`.
The reference traces the ray of each pixel's centre and uses the largest value of each
gaussian on it. Like the picture that it is compared with, it blends by the distance of
the means for the first two ways, and by that of the largest values for the third. The
table has the mean and the 99th percentile of the differences of colour and alpha, by
latitude and by the size of the gaussians, which is their standard deviation as an
angle.
"""

import argparse
import math

import numpy as np

import v3dg
from v3dg import Camera, EquirectangularCamera, Gaussians
from v3dg._numbers import Floats
from v3dg.rotations import rotation_from_quaternion

_WIDTH = 192
_NUM_GAUSSIANS = 600
_SIZES = (0.5, 2.0, 8.0)  # in degrees
_BANDS = ((0, 30), (30, 60), (60, 80), (80, 90))  # in degrees
_MIN_ALPHA = 1 / 255
_MAX_ALPHA = 0.999


def random_gaussians(rng: np.random.Generator, degrees: float) -> Gaussians:
    """Gaussians in all directions from the origin, at distances of 2 to 6."""
    n = _NUM_GAUSSIANS
    directions = rng.normal(size=(n, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    distance = rng.uniform(2, 6, n)
    size = distance * math.radians(degrees)
    scales = size[:, None] * np.exp(rng.normal(0, 0.4, (n, 3)))
    return Gaussians(
        means=(distance[:, None] * directions).astype(np.float32),
        quats=rng.normal(size=(n, 4)).astype(np.float32),
        scales=scales.astype(np.float32),
        opacities=rng.uniform(0.2, 0.9, n).astype(np.float32),
        sh=rng.normal(0, 0.6, (n, 1, 3)).astype(np.float32),
    )


def _covariance(gaussians: Gaussians, i: int) -> Floats:
    quaternion = gaussians.quats[i].astype(np.float64)
    axes = rotation_from_quaternion(quaternion / np.linalg.norm(quaternion))
    scaled = axes * gaussians.scales[i].astype(np.float64)
    return np.asarray(scaled @ scaled.T)


def alphas_on_rays(gaussians: Gaussians, rays: Floats) -> tuple[Floats, Floats]:
    """Return alphas (N, R), and ranges (N, R) at which gaussians have their largest
    values on rays."""
    alphas = np.zeros((len(gaussians), len(rays)))
    ranges = np.zeros_like(alphas)
    for i in range(len(gaussians)):
        precision = np.linalg.inv(_covariance(gaussians, i))
        mean = gaussians.means[i].astype(np.float64)
        steps = rays @ precision
        ranges[i] = (steps @ mean) / (steps * rays).sum(axis=1)
        offset = ranges[i][:, None] * rays - mean
        square = ((offset @ precision) * offset).sum(axis=1)
        alphas[i] = gaussians.opacities[i] * np.exp(-0.5 * square) * (ranges[i] > 0)
    return alphas, ranges


def alphas_by_projection(gaussians: Gaussians, width: int) -> Floats:
    """Return (N, R) alphas of the linearised projections, in float64."""
    per_radian = width / (2 * math.pi)
    rows, columns = np.mgrid[: width // 2, :width] + 0.5
    alphas = np.zeros((len(gaussians), rows.size))
    for i in range(len(gaussians)):
        x, y, z = gaussians.means[i].astype(np.float64)
        across2 = x * x + z * z
        across = math.sqrt(across2)
        distance2 = across2 + y * y
        u = width / 2 + per_radian * math.atan2(x, z)
        v = width / 4 + per_radian * math.atan2(y, across)
        by_point = per_radian * np.array(
            [
                [z / across2, 0, -x / across2],
                [-x * y / (across * distance2), across / distance2, -z * y / (across * distance2)],
            ]
        )
        conic = np.linalg.inv(by_point @ _covariance(gaussians, i) @ by_point.T)
        offset_u = (columns.ravel() - u + width / 2) % width - width / 2
        offset_v = rows.ravel() - v
        square = conic[0, 0] * offset_u**2 + 2 * conic[0, 1] * offset_u * offset_v
        square += conic[1, 1] * offset_v**2
        alphas[i] = gaussians.opacities[i] * np.exp(-0.5 * square)
    return alphas


def blended(gaussians: Gaussians, alphas: Floats, order: Floats) -> Floats:
    """Return (R, 4) colour and alpha. Gaussians are blended by ascending `order` (N,
    R)."""
    blendable = np.where(alphas >= _MIN_ALPHA, np.minimum(alphas, _MAX_ALPHA), 0)
    shade = np.maximum(0.28209479177387814 * gaussians.sh[:, 0].astype(np.float64) + 0.5, 0)
    rank = np.argsort(order, axis=0, kind="stable")
    sorted_alphas = np.take_along_axis(blendable, rank, axis=0)
    passed = np.cumprod(1 - sorted_alphas, axis=0)
    arriving = np.concatenate([np.ones((1, passed.shape[1])), passed[:-1]])
    weights = arriving * sorted_alphas
    color = np.einsum("nr,nrc->rc", weights, shade[rank])
    return np.column_stack([color, 1 - passed[-1]])


def _drawn(image: v3dg.Image) -> Floats:
    return np.column_stack([image.color.reshape(-1, 3), image.alpha.ravel()])


def differences(gaussians: Gaussians) -> dict[str, Floats]:
    """Return the absolute differences (R, 4) to rays for each way of drawing."""
    camera = EquirectangularCamera(np.eye(4), _WIDTH)
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = camera.directions(np.column_stack([columns.ravel(), rows.ravel()]))
    alphas, ranges = alphas_on_rays(gaussians, rays)
    distances = np.linalg.norm(gaussians.means.astype(np.float64), axis=1)
    by_mean = np.broadcast_to(distances[:, None], ranges.shape)
    of_means = blended(gaussians, alphas, by_mean)
    projected = blended(gaussians, alphas_by_projection(gaussians, _WIDTH), by_mean)
    level = Camera(np.eye(4), np.eye(3), 1, 1)
    stitched = v3dg.draw_panorama(
        lambda view: v3dg.rasterize(gaussians, view), level, (0, -1, 0), _WIDTH
    )
    traced = v3dg.render(gaussians, camera, device="cpu")
    return {
        "EWA in longitude and latitude": np.abs(projected - of_means),
        "26 pinholes": np.abs(_drawn(stitched) - of_means),
        "rays": np.abs(_drawn(traced) - blended(gaussians, alphas, ranges)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scenes", type=int, default=2, help="random scenes of each kind")
    options = parser.parse_args()
    latitude = np.abs(90 - (np.arange(_WIDTH // 2) + 0.5) * 360 / _WIDTH)
    latitudes = np.repeat(latitude, _WIDTH)
    print("| way | latitude | " + " | ".join(f"{size:g}°" for size in _SIZES) + " |")
    print("| --- | --- |" + " --- |" * len(_SIZES))
    errors_by_size = {
        size: [
            differences(random_gaussians(np.random.default_rng(seed), size))
            for seed in range(options.scenes)
        ]
        for size in _SIZES
    }
    for way in errors_by_size[_SIZES[0]][0]:
        for low, high in _BANDS:
            is_in_band = (latitudes >= low) & (latitudes < high)
            cells = []
            for size in _SIZES:
                errors = np.concatenate(
                    [scene[way][is_in_band].ravel() for scene in errors_by_size[size]]
                )
                cells.append(f"{errors.mean():.1e}, {np.quantile(errors, 0.99):.1e}")
            print(f"| {way} | {low}° to {high}° | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
