"""Hard cases for rasterizers: the CPU and CUDA draw and differentiate them, and are
compared with float64.

Tests check each case against its bounds, forward and backward, on both devices.
benchmarks/studies/hard_cases.py measures the distribution of the errors and writes the
table of docs/numerics.md.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np

import scenes
import v3dg
from compare import (
    CUTOFF_FLOAT,
    FAR_ASIDE_FLOAT,
    GRADIENT_FLOAT,
    GRADIENT_NEEDLES,
    NEEDLES_FLOAT,
    PICTURE_FLOAT,
    GradientBound,
    PictureBound,
)
from devices import host, on
from reference import project as reference_project
from reference import rasterize as reference_rasterize
from v3dg import Camera, Gaussians

PLAIN = scenes.CAMERAS["plain"]
FILTER = {"filter_px2": 0.3}
ANTIALIASED = {"filter_px2": 0.3, "antialiased": True}
NUM = 60


@dataclass(frozen=True)
class HardCase:
    """One scene, its settings, and how far float32 may be from float64."""

    what: str
    gaussians: Gaussians
    camera: Camera = PLAIN
    mode: dict[str, Any] = field(default_factory=dict)
    picture: PictureBound = PICTURE_FLOAT
    # None means that the gradient has to be finite, without a bound for its error.
    gradient: GradientBound | None = GRADIENT_FLOAT
    is_drawn: bool = True  # whether at least one pixel is drawn


def crowd(
    seed: int, camera: Camera = PLAIN, num: int = NUM, *, sh_degree: int = 1, **changes: Any
) -> Gaussians:
    """Return ordinary gaussians in front of the camera, with some arrays replaced; one
    row may be used for all."""
    g = scenes.random_gaussians(seed, camera, num, size_px=(1, 8), aspect=4.0, sh_degree=sh_degree)
    rows = {
        n: np.broadcast_to(np.asarray(v, np.float32), getattr(g, n).shape)
        for n, v in changes.items()
    }
    return scenes.replaced(g, **{n: np.array(v, order="C") for n, v in rows.items()})


def zoomed(factor: float) -> tuple[Gaussians, Camera]:
    """Return a scene that is `factor` times as large, with its camera and near plane
    scaled accordingly."""
    camera = scenes.CAMERAS["posed"]
    g = crowd(2, camera)
    viewmat = camera.viewmat.copy()
    viewmat[:3, 3] *= factor
    larger = scenes.replaced(
        g, means=g.means * np.float32(factor), scales=g.scales * np.float32(factor)
    )
    return larger, Camera(viewmat, camera.K, camera.width, camera.height, near=0.01 * factor)


def away(distance: float) -> tuple[Gaussians, Camera]:
    """Return a scene and its camera far from the origin, on no axis of the world or the
    camera."""
    posed = scenes.CAMERAS["posed"]
    viewmat = posed.viewmat.copy()
    viewmat[:3, 3] -= viewmat[:3, :3] @ (distance * np.array([0.6, -0.64, 0.48]))
    camera = Camera(viewmat, posed.K, posed.width, posed.height)
    return crowd(2, camera, sh_degree=2), camera


def bad_rows(array: np.ndarray, value: float) -> np.ndarray:
    """Return the array with `value` somewhere in every tenth row."""
    bad = array.copy()
    bad.reshape(len(bad), -1)[::10, 0] = value
    return bad


def shapes() -> dict[str, HardCase]:
    grid = [[x / 5, y / 5, 2.0] for x in range(-4, 5) for y in range(-4, 5)]
    diagonal = scenes.gaussians(grid, quats=(0.92388, 0, 0, 0.38268), scales=(0.3, 3e-7, 1e-7))
    half_flat = np.where(np.arange(NUM)[:, None] % 2, 0.0, [0.05, 0.02, 0.1])
    return {
        "needles of aspect 10⁶": HardCase(
            "The determinant is a sum of positive terms: no digit is lost.",
            crowd(1, scales=(0.3, 3e-7, 3e-7)),
            mode=FILTER,
        ),
        "needles of aspect 10⁶, no filter": HardCase(
            "Thinner than what float32 resolves of a position at 10³ px, so the falloff across "
            "them is off.",
            crowd(1, scales=(3000.0, 3e-3, 3e-3)),
            picture=NEEDLES_FLOAT,
        ),
        "needles, antialiased": HardCase(
            "Compensation divides by a determinant that is nearly that of the filter alone.",
            crowd(1, scales=(0.3, 3e-3, 3e-3)),
            mode=ANTIALIASED,
        ),
        "determinants that cancel": HardCase(
            "Needles along a diagonal: a c - b² would be a difference of equal numbers.",
            diagonal,
            mode=FILTER,
        ),
        "pancakes of aspect 10⁶": HardCase(
            "As needles; edge-on they are lines.", crowd(1, scales=(0.3, 0.3, 3e-7)), mode=FILTER
        ),
        "pancakes of aspect 10⁶, no filter": HardCase(
            "Edge-on ones fall between pixel centres, and are then not drawn.",
            crowd(1, scales=(0.3, 0.3, 3e-7)),
            gradient=GRADIENT_NEEDLES,
        ),
        "scales of 0": HardCase(
            "With a filter a point becomes the filter's own disc.",
            crowd(3, scales=half_flat),
            mode=FILTER,
        ),
        "scales of 0, no filter": HardCase("No area: not drawn.", crowd(3, scales=half_flat)),
        "denormal scales": HardCase("As 0.", crowd(3, scales=(1e-40, 3e-41, 1e-39)), mode=FILTER),
        "denormal scales, no filter": HardCase(
            "The determinant underflows to 0: not drawn. In float64 they are, between pixel "
            "centres.",
            crowd(3, scales=(1e-40, 3e-41, 1e-39)),
            is_drawn=False,
        ),
        "scales of 10⁶ and more": HardCase(
            "Flat over the picture. Past a deviation of 4 x 10⁹ px the determinant overflows: not "
            "drawn.",
            crowd(4, scales=(1e6, 2e6, 5e7), opacities=0.1),
        ),
        "quaternions of length 10¹⁵": HardCase(
            "Normalised, as is any length.",
            crowd(5, quats=1e15 * crowd(5).quats),
            mode=FILTER,
        ),
        "quaternions of length 10⁻¹⁵": HardCase(
            "Normalised, as is any length.",
            crowd(5, quats=1e-15 * crowd(5).quats),
            mode=FILTER,
        ),
        "quaternions of 0": HardCase(
            "No rotation, and no gradient.",
            crowd(5, quats=0, scales=(0.05, 0.02, 0.1)),
            mode=FILTER,
        ),
    }


def values() -> dict[str, HardCase]:
    usual = crowd(6)
    cases = {
        "opacities of 0 and 1": HardCase(
            "0 is below the threshold: not drawn. 1 is cut at 0.999, where no gradient flows.",
            crowd(6, opacities=np.arange(NUM) % 2),
        ),
        "opacities above 1": HardCase("Cut at 0.999 like any alpha.", crowd(6, opacities=3.0)),
    }
    for name, value in (("NaN", np.nan), ("infinite", np.inf)):
        for array in ("means", "quats", "scales", "opacities"):
            if (name, array) == ("infinite", "opacities"):
                continue
            changed = scenes.replaced(usual, **{array: bad_rows(getattr(usual, array), value)})
            cases[f"{name} {array}"] = HardCase("Not drawn, and no gradient.", changed)
        colored = scenes.replaced(usual, sh=bad_rows(usual.sh, value))
        cases[f"{name} colours"] = HardCase(
            "The channel counts as 0, and has no gradient.", colored
        )
    return cases


def places() -> dict[str, HardCase]:
    rng = np.random.default_rng(0)
    around = rng.normal(0, 0.3, (NUM, 3))
    ahead = np.array([0, 0, 1])
    spread = rng.normal(0, [1, 1, 0], (NUM, 3)) * 10 ** rng.uniform(0, 5, (NUM, 1))
    crowded = 5000
    disc = np.column_stack([rng.uniform(-1, 1, (crowded, 2)), np.full(crowded, 2.0)])
    stairs = 2.0 + 2.4e-7 * rng.permutation(crowded)
    return {
        "means around the near plane": HardCase(
            "Not drawn before it. What lies behind is drawn whole, also where it reaches through "
            "the plane.",
            crowd(
                7,
                means=rng.normal(0, [0.01, 0.01, 0.05], (NUM, 3)),
                scales=rng.uniform(0.005, 0.2, (NUM, 3)),
                opacities=0.1,
            ),
        ),
        "far off the axis": HardCase(
            "The Jacobian is constant past 1.3 times the field of view, also in the backward pass.",
            crowd(
                8, means=spread + ahead, scales=10 ** rng.uniform(-1, 5, (NUM, 3)), opacities=0.1
            ),
        ),
        "larger than the screen": HardCase(
            "It only takes time.", crowd(9, scales=10 ** rng.uniform(0, 3, (NUM, 3)), opacities=0.1)
        ),
        "5,000 equal depths": HardCase(
            "Blended in the order of their index.",
            crowd(10, num=crowded, means=disc, opacities=0.05),
        ),
        "5,000 depths an ulp apart": HardCase(
            "Blended by depth.",
            crowd(
                10, num=crowded, means=np.column_stack([0.2 * disc[:, :2], stairs]), opacities=0.05
            ),
        ),
        "5,000 at one place": HardCase(
            "Blended in the order of their index. At the threshold all of them are drawn, or none.",
            crowd(10, num=crowded, means=(0.1, 0.1, 2.0), opacities=0.05),
            picture=CUTOFF_FLOAT,
        ),
        "cameras inside gaussians": HardCase(
            "Only the mean's depth counts.",
            crowd(11, means=around, scales=rng.uniform(0.3, 3, (NUM, 3)), opacities=0.1),
        ),
        "cameras on means": HardCase(
            "A depth of 0: not drawn.",
            crowd(11, means=around * (np.arange(NUM)[:, None] % 2), opacities=0.1),
            mode=FILTER,
        ),
        "100,000 layers on a pixel": HardCase(
            "It stops after some 2,000 of them; the transmittance is a product of as many rounded "
            "factors.",
            scenes.gaussians(
                np.column_stack([np.zeros((100_000, 2)), np.linspace(1, 3, 100_000)]),
                quats=(0.9, 0.1, 0.2, 0.3),
                scales=(10.0, 8.0, 5.0),
                opacities=0.005,
                color=rng.uniform(0, 1, (100_000, 3)),
            ),
            scenes.CAMERAS["one_pixel"],
        ),
        "alphas at the thresholds": HardCase(
            "1/255 and 0.999 to the last bit: either side is right.",
            scenes.gaussians(
                [[0.01, 0.01, 1.0], [0.02, 0.02, 2.0], [0.06, 0.06, 3.0]],
                quats=(0.9, 0.1, 0.2, 0.3),
                scales=(1e6, 8e5, 5e5),
                opacities=[1 / 255, 0.999, 0.5],
            ),
            picture=CUTOFF_FLOAT,
            gradient=None,
        ),
        "transmittances at the stop": HardCase(
            "10⁻⁴ to the last bit: either side is right.",
            scenes.gaussians(
                [[0, 0, 1.0], [0, 0, 2.0], [0, 0, 3.0]],
                quats=(0.9, 0.1, 0.2, 0.3),
                scales=(1e6, 8e5, 5e5),
                opacities=[0.9, 0.99, 0.9],
            ),
            picture=CUTOFF_FLOAT,
            gradient=None,
        ),
    }


def cameras() -> dict[str, HardCase]:
    telescope, wide = scenes.camera(fx=5e5), scenes.camera(64, 48, fx=0.5)
    aside = scenes.camera(fx=60.0, cx=-4000.0, cy=2500.0)
    column, row, pixel = scenes.camera(1, 40), scenes.camera(70, 1), scenes.CAMERAS["one_pixel"]
    k = np.arange(-20, 20)
    distant = np.column_stack([0.6 * k, k % 7 - 3.0, np.full(40, 50.0)]) * 2e7
    small, large = zoomed(1e-6), zoomed(1e6)
    far = {power: away(10.0**power) for power in (3, 5)}
    return {
        "a scene 10⁻⁶ across": HardCase("No formula has a size of its own.", *small, mode=FILTER),
        "a scene 10⁶ across": HardCase(
            "As above: no formula has a size of its own.", *large, mode=FILTER
        ),
        "means 10³ from zero, eye beside them": HardCase(
            "The eye is subtracted first, which takes no digit from what is near it.",
            *far[3],
            mode=FILTER,
        ),
        "means 10⁵ from zero, eye beside them": HardCase(
            "As above: what float32 loses is in the means before they are drawn.",
            *far[5],
            mode=FILTER,
        ),
        "a camera 10⁹ away": HardCase(
            "Depths are as float32 has them: 60 units apart, or ties.",
            scenes.gaussians(distant, quats=(0.9, 0.1, 0.2, 0.3), scales=(2e7, 1e7, 3e7)),
            mode=FILTER,
        ),
        "a field of view of 0.005°": HardCase(
            "Nothing special.", crowd(12, telescope), telescope, FILTER
        ),
        "a field of view of 178°": HardCase(
            "Past 1.3 times that, the Jacobian is constant.", crowd(13, wide), wide, FILTER
        ),
        "a principal point 4,000 px aside": HardCase(
            "A place on the screen is a difference of numbers of that size: off by 5e-4 px.",
            crowd(14, aside),
            aside,
            FILTER,
            FAR_ASIDE_FLOAT,
        ),
        "a picture of one column": HardCase("Nothing special.", crowd(15, column), column, FILTER),
        "a picture of one row": HardCase("Nothing special.", crowd(16, row), row, FILTER),
        "a picture of one pixel": HardCase("Nothing special.", crowd(17, pixel), pixel, FILTER),
    }


@functools.cache
def hard_cases() -> dict[str, HardCase]:
    return {**shapes(), **values(), **places(), **cameras()}


# The functions below measure errors.


def picture(case: HardCase, device: str) -> v3dg.Image:
    """Return the picture in float32, as NumPy arrays."""
    raster = v3dg.rasterize(on(device, case.gaussians), case.camera, **case.mode)
    return v3dg.Image(*host((raster.color, raster.alpha, raster.depth)))


def expected_picture(case: HardCase) -> reference_rasterize.Picture:
    with np.errstate(all="ignore"):  # some of the gaussians are NaN
        return reference_rasterize.rasterize(case.gaussians, case.camera, **case.mode)


def picture_error(raster: v3dg.Image, expected: reference_rasterize.Picture) -> np.ndarray:
    """Return (H, W) the largest error of colour and alpha."""
    return np.maximum(
        np.abs(raster.color - expected.color).max(axis=2), np.abs(raster.alpha - expected.alpha)
    )


def drawn_rows(case: HardCase) -> np.ndarray:
    """Return (N,) whether the gaussian is drawn according to its projection and has a
    finite colour."""
    g = case.gaussians
    with np.errstate(all="ignore"):
        projection = reference_project.project(
            g, case.camera, filter_px2=case.mode.get("filter_px2", 0.0)
        )
    is_number = np.isfinite(g.opacities) & np.isfinite(g.sh).all((1, 2))
    return projection.is_drawable & is_number


def gradients(
    case: HardCase, draw: Callable[..., Any], dtype: Any, device: str = "cpu"
) -> list[np.ndarray]:
    """Return the gradients, with respect to the five inputs, of a number that depends
    on every pixel of colour, alpha and depth.

    `draw` takes the five inputs as tensors, the camera and the mode. Depth is divided
    by the depth of the nearest gaussian.
    """
    import torch

    inputs = [
        torch.tensor(getattr(case.gaussians, name), dtype=dtype, device=device, requires_grad=True)
        for name in scenes.NAMES
    ]
    rng = np.random.default_rng(0)
    color, alpha, depth = draw(inputs, case.camera, case.mode)
    nearest = depth.detach()[alpha.detach() > 0].min().item() if (alpha > 0).any() else 1.0
    total = sum(
        (p * torch.from_numpy(rng.normal(size=tuple(p.shape))).to(p)).sum()
        for p in (color, alpha, depth / nearest)
    )
    return [np.asarray(g, np.float64) for g in host(torch.autograd.grad(total, inputs))]


def draw_core(inputs: Sequence[Any], camera: Camera, mode: dict[str, Any]) -> tuple[Any, Any, Any]:
    """Draw with v3dg, in the precision of the inputs."""
    g: Any = SimpleNamespace(**dict(zip(scenes.NAMES, inputs, strict=True)))
    raster = v3dg.rasterize(g, camera, **mode)
    return raster.color, raster.alpha, raster.depth


def relative_changes(case: HardCase, by_inputs: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return gradients by relative changes: of a mean by its distance, of a scale by
    itself, and so on.

    These gradients can be compared between scenes of any size. The gradient of NaN
    inputs is 0.
    """
    g = case.gaussians
    distance = np.linalg.norm(np.asarray(g.means, np.float64) - case.camera.position, axis=1)[
        :, None
    ]
    units = (
        distance,
        np.linalg.norm(g.quats.astype(np.float64), axis=1)[:, None],
        g.scales.astype(np.float64),
        1.0,
        1.0,
    )
    with np.errstate(invalid="ignore"):
        relative = [d * unit for d, unit in zip(by_inputs, units, strict=True)]
    return [
        np.where(np.isfinite(r) | (d != 0), r, 0.0)
        for r, d in zip(relative, by_inputs, strict=True)
    ]


def gradient_errors(got: Sequence[np.ndarray], expected: Sequence[np.ndarray]) -> list[float]:
    """Return the L2 distance for each input, relative to its norm, or to 1e-6 of the
    norm of all inputs if that is larger."""
    whole = np.sqrt(sum((e * e).sum() for e in expected))
    return [
        float(np.linalg.norm(g - e) / max(np.linalg.norm(e), 1e-6 * whole, 1e-300))
        for g, e in zip(got, expected, strict=True)
    ]
