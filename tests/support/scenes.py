"""Small scenes: made by hand, random with the sizes of trained assets, invalid and
degenerate.

A scene is a `Gaussians` (NumPy, float32) and a `Camera`. Random gaussians are placed in
front of their camera, with positions and sizes in pixels; their depths differ by far
more than float32 rounding.
"""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np

from reference import project as reference_project
from reference import rasterize as reference_rasterize
from reference import sh as reference_sh
from v3dg import Camera, Gaussians

SH_C0 = 0.28209479177387814
NAMES = ("means", "quats", "scales", "opacities", "sh")


def camera(
    width=48, height=40, *, fx=50.0, fy=None, cx=None, cy=None, pose=None, near=0.01
) -> Camera:
    """Return a camera with square pixels and a centred principal point by default,
    which looks along z unless it has a pose."""
    K = [[fx, 0, width / 2 if cx is None else cx], [0, fx if fy is None else fy, 0], [0, 0, 1]]
    K[1][2] = height / 2 if cy is None else cy
    return Camera(np.eye(4) if pose is None else pose, K, width, height, near)


def pose(seed: int, distance: float = 2.0) -> np.ndarray:
    """Return a world-to-view matrix with a random rotation and an eye a few units from
    the origin."""
    rng = np.random.default_rng(seed)
    viewmat = np.eye(4)
    viewmat[:3, :3] = reference_project.rotation(rng.normal(size=(1, 4)))[0]
    viewmat[:3, 3] = rng.uniform(-distance, distance, size=3)
    return viewmat


# One camera for each special case of the formulas.
CAMERAS = {
    "plain": camera(),
    "posed": camera(pose=pose(1)),
    "off_centre": camera(61, 37, fx=45.0, cx=9.5, cy=31.25, pose=pose(2)),
    "non_square": camera(33, 70, fx=38.0, fy=81.0, cx=14.0, cy=40.5, pose=pose(3)),
    # The principal point is outside of the image.
    "outside": camera(40, 40, fx=60.0, cx=-25.0, cy=55.0, pose=pose(4)),
    # The field of view is 139 degrees: slopes are large, and Jacobians are clamped.
    "wide": camera(64, 32, fx=12.0, pose=pose(5)),
    "one_pixel": camera(1, 1, fx=3.0),
}


def gaussians(
    means, quats=(1, 0, 0, 0), scales=0.1, opacities=0.8, color=(0.9, 0.5, 0.2), sh=None
) -> Gaussians:
    """Return explicit gaussians; a single row is used for all. `color` sets SH degree
    0, unless `sh` is given."""
    means = np.atleast_2d(np.asarray(means, np.float32))
    num = len(means)

    def rows(value, *shape):
        return np.ascontiguousarray(np.broadcast_to(np.asarray(value, np.float32), (num, *shape)))

    if sh is None:
        sh = (rows(color, 3)[:, None, :] - np.float32(0.5)) / np.float32(SH_C0)
    return Gaussians(
        np.ascontiguousarray(means),
        rows(quats, 4),
        rows(scales, 3),
        rows(opacities),
        np.ascontiguousarray(sh),
    )


def random_gaussians(
    seed,
    camera,
    num,
    *,
    size_px=(0.3, 6.0),
    aspect=30.0,
    sh_degree=0,
    opacity=(0.02, 1.0),
    depth=(1.0, 4.0),
    margin=0.2,
) -> Gaussians:
    """Return gaussians all over the image and beyond it by `margin` of its size.

    The largest standard deviation is log-uniform in `size_px`, in pixels; the others
    are smaller by up to `aspect`.
    """
    rng = np.random.default_rng(seed)
    step = (depth[1] - depth[0]) / max(num, 1)
    depths = depth[0] + step * (rng.permutation(num) + rng.uniform(0.3, 0.7, num))
    size = np.array([camera.width, camera.height])
    place = rng.uniform(-margin, 1 + margin, (num, 2)) * size
    slope = (place - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    view = np.concatenate([slope * depths[:, None], depths[:, None]], axis=1)
    to_view = camera.viewmat[:3, :3]
    means = (view - camera.viewmat[:3, 3]) @ to_view
    largest = np.exp(rng.uniform(*np.log(size_px), num)) * depths / math.sqrt(camera.fx * camera.fy)
    shape = np.exp(-rng.uniform(0, math.log(aspect), (num, 3)))
    scales = largest[:, None] * shape / shape.max(axis=1, keepdims=True)
    quats = rng.normal(size=(num, 4)) * rng.uniform(0.5, 2.0, (num, 1))
    num_bases = (sh_degree + 1) ** 2
    decay = np.array([1.0 / (1 + math.isqrt(k)) for k in range(num_bases)])
    sh = rng.normal(0, 0.7, (num, num_bases, 3)) * decay[:, None]
    return Gaussians(
        *(
            np.ascontiguousarray(a, dtype=np.float32)
            for a in (means, quats, scales, rng.uniform(*opacity, num), sh)
        )
    )


def trained_like(seed, camera, num, sh_degree=3) -> Gaussians:
    """Return gaussians like those of training: many small, some large, thin discs and
    needles, with opacities concentrated at both ends."""
    g = random_gaussians(seed, camera, num, size_px=(0.1, 20.0), aspect=1e3, sh_degree=sh_degree)
    rng = np.random.default_rng(seed + 1)
    return replaced(g, opacities=rng.beta(0.4, 0.4, num).astype(np.float32))


def replaced(g, **arrays) -> Gaussians:
    return Gaussians(**{name: arrays.get(name, getattr(g, name)) for name in NAMES})


def degenerate() -> dict[str, Gaussians]:
    """Return valid but extreme gaussians for the camera `CAMERAS["plain"]`."""
    on_grid = [[x / 5, y / 5, 2.0] for x in range(-4, 5) for y in range(-4, 5)]
    return {
        "empty": gaussians(np.zeros((0, 3))),
        "one": gaussians([0.03, 0.02, 1.5]),
        "behind": gaussians([[0, 0, -1], [0.1, 0, -0.01], [0, 0.1, 0]]),
        "around_near": gaussians(
            [[0, 0, 0.0099], [1e-4, 0, 0.0101], [0, 1e-4, 0.05]], scales=0.001
        ),
        "larger_than_screen": gaussians(
            [[0, 0, 2], [0.3, -0.2, 3]], scales=[[30.0] * 3, [100.0] * 3]
        ),
        "far_off_axis": gaussians(
            [[8, 0.3, 1], [-0.2, 9, 1.5], [-30, -30, 2]], scales=[[3.0] * 3, [5.0] * 3, [20.0] * 3]
        ),
        "far_away": gaussians([[100, -80, 1e4], [1e5, 2e5, 1e6]], scales=[[100.0] * 3, [5e4] * 3]),
        "tiny": gaussians(on_grid, scales=1e-4),
        "tiny_on_pixel_centres": gaussians(np.add(on_grid, [0.02, 0.02, 0]), scales=1e-4),
        "smaller_than_any_pixel": gaussians([[0.0312, 0.0213, 2.0]], scales=1e-12),
        "needles": gaussians(
            on_grid, quats=(0.9, 0.1, 0.3, 0.2), scales=(0.5, 5e-4, 5e-4), opacities=0.9
        ),
        "discs_edge_on": gaussians(on_grid, quats=(1, 0, 1e-3, 0), scales=(1e-4, 0.2, 0.2)),
        "equal_depths": gaussians(
            [[0.02 * i, 0.01 * i, 2.0] for i in range(12)],
            scales=0.2,
            color=np.eye(3)[np.arange(12) % 3],
        ),
        "same_place": gaussians(
            [[0.1, 0.1, 2.0]] * 7, color=np.random.default_rng(0).uniform(size=(7, 3))
        ),
        "opacity_zero": gaussians([[0, 0, 2.0], [0.1, 0, 3.0]], opacities=[0.0, 0.7]),
        "opacity_one": gaussians(
            [[0, 0, 2.0], [0.1, 0, 3.0], [0, 0.1, 4.0]], scales=3.0, opacities=1.0
        ),
        "opacity_below_threshold": gaussians([[0, 0, 2.0]], opacities=0.0039),
        "one_flat_axis": gaussians([[0, 0, 2.0]], quats=(1, 0.3, 0.2, 0), scales=(0.3, 0.2, 0.0)),
        "two_flat_axes": gaussians(
            [[0.013, 0.007, 2.0]], quats=(1, 0.3, 0.2, 0), scales=(0.3, 0.0, 0.0)
        ),
        "zero_scale": gaussians([[0.013, 0.007, 2.0]], scales=0.0),
        "long_and_short_quats": gaussians(
            [[-0.3, 0, 2.0], [0.3, 0, 2.0]],
            quats=[[1e4, 2e4, 0, 1e4], [1e-5, 2e-5, 0, 1e-5]],
            scales=(0.3, 0.1, 0.02),
        ),
        "zero_quats": gaussians([0.1, 0, 2.0], quats=0, scales=(0.3, 0.1, 0.2)),
        "negative_colors": gaussians([[0, 0, 2.0]], color=(-3.0, 0.5, -0.1)),
        "thick_fog": gaussians(
            [[0, 0, 2 + 0.01 * i] for i in range(300)], scales=0.5, opacities=0.05
        ),
    }


def poison() -> dict[str, Gaussians]:
    """Return single invalid gaussians, large and in front of the camera
    `CAMERAS["plain"]`."""
    good = {
        "means": [0, 0, 1.0],
        "quats": (1, 0, 0, 0),
        "scales": (0.3, 0.3, 0.3),
        "opacities": 0.9,
    }
    poisoned = {}
    for name, place in (
        ("means", 0),
        ("means", 2),
        ("quats", 1),
        ("scales", 1),
        ("opacities", None),
    ):
        for value in (math.nan, math.inf, -math.inf):
            if name == "opacities":
                changed = value
            else:
                changed = list(good[name])
                changed[place] = value
            if (name, value) != ("opacities", math.inf):
                poisoned[f"{name}{'' if place is None else place}_{value}"] = gaussians(
                    **{**good, name: changed}
                )
    poisoned["opacities_negative"] = gaussians(**{**good, "opacities": -0.5})
    poisoned["scales_overflow"] = gaussians(**{**good, "scales": (1e30, 1e30, 1e30)})
    return poisoned


def doubles(g, *, torch, requires_grad=False) -> SimpleNamespace:
    """Return the same gaussians as float64 torch tensors, for the core's double
    precision."""
    return SimpleNamespace(
        **{
            name: torch.from_numpy(np.array(getattr(g, name), np.float64)).requires_grad_(
                requires_grad
            )
            for name in NAMES
        }
    )


def leaves(torch, gaussians, background, dtype, device="cpu"):
    """Return the five inputs and the background as leaf tensors."""
    arrays = [getattr(gaussians, name) for name in NAMES] + [background]
    return [
        torch.tensor(np.asarray(a), dtype=dtype, device=device, requires_grad=True) for a in arrays
    ]


def is_smooth(g, camera, *, filter_px2=0.0, antialiased=False, band=1e-3) -> bool:
    """Return whether nothing in the picture is near a discontinuity of a value or a
    derivative, so that finite differences are accurate."""
    options = {"filter_px2": filter_px2, "antialiased": antialiased}
    picture = reference_rasterize.rasterize(g, camera, **options)
    projection = reference_project.project(g, camera, filter_px2=filter_px2)
    means = np.asarray(g.means, np.float64)
    degree = math.isqrt(g.sh.shape[1]) - 1
    series = np.einsum(
        "nk,nkc->nc",
        reference_sh.basis(means - camera.position, degree),
        np.asarray(g.sh, np.float64),
    )
    slope = (projection.mean_px - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    size, center = np.array([camera.width, camera.height]), np.array([camera.cx, camera.cy])
    focal = np.array([camera.fx, camera.fy])
    limits = np.stack([-center, size - center]) / focal + [[-1], [1]] * (0.15 * size / focal)
    return bool(
        picture.cutoff_distance.min() > band
        and picture.clamp_distance.min() > band
        and np.diff(np.sort(projection.depth)).min(initial=1.0) > 1e-6
        and np.abs(series + 0.5).min() > band
        and np.abs(slope[:, None, :] - limits).min() > band
        and np.abs(projection.depth - camera.near).min() > band
    )


def first_smooth(make, camera, **options) -> Gaussians:
    """Return the first smooth result of `make(seed)`, seed = 0, 1, ..."""
    for seed in range(200):
        g = make(seed)
        if is_smooth(g, camera, **options):
            return g
    raise AssertionError("no smooth scene in 200 seeds: make it smaller")
