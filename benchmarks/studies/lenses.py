"""The error of pictures through lenses. The projection, which is linearised at the mean
of each gaussian, is compared with rays in float64.

    python -m benchmarks.studies.lenses

The reference traces a ray through the centre of each pixel. The falloff of a gaussian
is its largest value on the ray in front of the eye. Gaussians are blended in the same
order as in the pictures, without a filter. The table has mean and largest differences
of alpha and colour, by camera and by the size of the gaussians, which is their standard
deviation as an angle.
"""

import argparse
import math

import numpy as np

import v3dg
from v3dg import Camera, Gaussians
from v3dg._numbers import Floats
from v3dg.rotations import rotation_from_quaternion

_WIDTH = 160
_HEIGHT = 120
_NUM_GAUSSIANS = 400
_SIZES = (0.5, 2.0, 8.0)  # in degrees
_MIN_ALPHA = 1 / 255
_MAX_ALPHA = 0.999
_MIN_TRANSMITTANCE = 1e-4


def cameras() -> dict[str, Camera]:
    """Cameras of about the same field of view at the axis, by name."""
    viewmat = np.eye(4)
    size = {"width": _WIDTH, "height": _HEIGHT}

    def intrinsics(focal: float) -> Floats:
        return np.array([[focal, 0, _WIDTH / 2], [0, focal, _HEIGHT / 2], [0, 0, 1]])

    barrel = (-0.2, 0.03, 0.001, -0.001)
    pincushion = (0.15, 0.03, -0.001, 0.001)
    fisheye = (0.02, -0.005, 0.0, 0.0)
    return {
        "pinhole, 77°": Camera(viewmat, intrinsics(100), **size),
        "barrel": Camera(viewmat, intrinsics(100), **size, distortion=barrel, model="OPENCV"),
        "pincushion": Camera(
            viewmat, intrinsics(100), **size, distortion=pincushion, model="OPENCV"
        ),
        "fisheye, 90°": Camera(
            viewmat, intrinsics(100), **size, distortion=fisheye, model="OPENCV_FISHEYE"
        ),
        "fisheye, 180°": Camera(
            viewmat, intrinsics(50), **size, distortion=(0.0,) * 4, model="OPENCV_FISHEYE"
        ),
    }


def random_gaussians(rng: np.random.Generator, degrees: float, most_angle: float) -> Gaussians:
    """Gaussians around the eye at distances of 2 to 6, up to an angle from the axis."""
    n = _NUM_GAUSSIANS
    angle = most_angle * np.sqrt(rng.uniform(0, 1, n))
    turn = rng.uniform(0, 2 * math.pi, n)
    distance = rng.uniform(2, 6, n)
    across = np.sin(angle)
    direction = np.column_stack([across * np.cos(turn), across * np.sin(turn), np.cos(angle)])
    size = distance * math.radians(degrees)
    scales = size[:, None] * np.exp(rng.normal(0, 0.4, (n, 3)))
    return Gaussians(
        means=(distance[:, None] * direction).astype(np.float32),
        quats=rng.normal(size=(n, 4)).astype(np.float32),
        scales=scales.astype(np.float32),
        opacities=rng.uniform(0.2, 0.9, n).astype(np.float32),
        sh=rng.normal(0, 0.6, (n, 1, 3)).astype(np.float32),
    )


def traced(gaussians: Gaussians, camera: Camera) -> tuple[Floats, Floats]:
    """Return colour and alpha along rays from a camera at the origin, in float64."""
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = camera.directions(np.column_stack([columns.ravel(), rows.ravel()]))
    means = gaussians.means.astype(np.float64)
    depths = means[:, 2]
    if camera.model == "OPENCV_FISHEYE":
        depths = np.linalg.norm(means, axis=1)
    transmittance = np.ones(len(rays))
    is_done = np.isnan(rays).any(axis=1)
    color = np.zeros((len(rays), 3))
    for i in np.argsort(depths, kind="stable"):
        if depths[i] < camera.near:
            continue
        alpha = gaussians.opacities[i] * _falloff(gaussians, i, rays)
        alpha = np.where(alpha >= _MIN_ALPHA, np.minimum(alpha, _MAX_ALPHA), 0)
        is_done |= transmittance * (1 - alpha) <= _MIN_TRANSMITTANCE
        alpha[is_done] = 0
        shade = np.maximum(0.28209479177387814 * gaussians.sh[i, 0].astype(np.float64) + 0.5, 0)
        color += (transmittance * alpha)[:, None] * shade
        transmittance *= 1 - alpha
    shape = (camera.height, camera.width)
    return color.reshape(*shape, 3), 1 - transmittance.reshape(shape)


def _falloff(gaussians: Gaussians, i: int, rays: Floats) -> Floats:
    """Return the largest value of a gaussian on each ray from the origin."""
    quaternion = gaussians.quats[i].astype(np.float64)
    rotation = rotation_from_quaternion(quaternion / np.linalg.norm(quaternion))
    whiten = rotation.T / gaussians.scales[i].astype(np.float64)[:, None]
    mean = whiten @ gaussians.means[i].astype(np.float64)
    steps = np.nan_to_num(rays) @ whiten.T
    distance = np.maximum((steps @ mean) / np.maximum((steps**2).sum(axis=1), 1e-300), 0)
    nearest = distance[:, None] * steps - mean
    return np.exp(-0.5 * (nearest**2).sum(axis=1))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scenes", type=int, default=3, help="random scenes of each kind")
    options = parser.parse_args()
    print("| camera | " + " | ".join(f"{size:g}°" for size in _SIZES) + " |")
    print("| --- |" + " --- |" * len(_SIZES))
    for name, camera in cameras().items():
        most_angle = 0.9
        if "180" in name:
            most_angle = 1.6
        cells = []
        for size in _SIZES:
            differences = []
            for seed in range(options.scenes):
                gaussians = random_gaussians(np.random.default_rng(seed), size, most_angle)
                image = v3dg.rasterize(gaussians, camera)
                color, alpha = traced(gaussians, camera)
                differences.append(np.abs(image.color - color).ravel())
                differences.append(np.abs(image.alpha - alpha).ravel())
            errors = np.concatenate(differences)
            cells.append(f"{errors.mean():.4f}, {np.quantile(errors, 0.99):.3f}")
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
