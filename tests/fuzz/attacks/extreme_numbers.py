"""Gaussians, cameras and poses with extreme numbers: zero, denormal, huge, infinite,
and NaN.

Pictures must be finite whatever is drawn, and gradients must be finite if float32 can
represent them. For sizes, distances and lengths of quaternions over many decades,
pictures must agree with the float64 reference within the bounds of docs/numerics.md.
Cuts must be the same with every instruction set. For each other instruction set, a
process returns digests.
"""

import dataclasses
import hashlib
import math
import os
import subprocess
import sys

import numpy as np
import torch

import v3dg
from compare import PICTURE_FLOAT, assert_pictures_agree
from fuzz.attacks.pool import Outcome
from random_bundle import random_bundle
from reference import rasterize as reference_rasterize
from v3dg import _core

LIMIT_S = 120
EXTREMES = (0.0, -0.0, 1e-45, 1e-38, 3e-23, 1e-20, 1e-10, 1e10, 1.8e19, 1e20, 1e38, 3.4e38)
NOT_FINITE = (math.nan, math.inf, -math.inf)
NAMES = ("means", "quats", "scales", "opacities", "sh")
MODES = ({}, {"filter_px2": 0.3}, {"filter_px2": 0.3, "antialiased": True})
# Pictures are so small that the mean over a few pixels would be no separate bound.
BOUND = dataclasses.replace(PICTURE_FLOAT, mean=PICTURE_FLOAT.absolute)
INSTRUCTION_SETS = ("baseline", "avx2", "avx512")


def prepare(shared):
    pass


class Attack:
    def __init__(self, shared):
        torch.set_num_threads(1)
        self._others = [Other(name) for name in INSTRUCTION_SETS if name != _core.isa()]

    def plan(self, rng, work):
        story = rng.choice((extreme_fault, reference_fault, self._cut_fault))
        seed = rng.getrandbits(32)

        def do():
            fault = story(seed)
            return Outcome("fault" if fault else "right", fault)

        return f"{story.__name__} of seed {seed}", do

    def _cut_fault(self, seed):
        mine = cut_digest(seed)
        for other in self._others:
            if (theirs := other.digest(seed)) not in (mine, None):
                return f"cut: {theirs} with {other.name}, {mine} with {_core.isa()}"
        return None


class Other:
    """A process that selects cuts with another instruction set; None if the machine
    lacks it."""

    def __init__(self, name):
        self.name = name
        self._process = subprocess.Popen(
            [sys.executable, "-m", "fuzz.attacks.extreme_numbers"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"V3DG_ISA": name},
        )
        self._is_there = self._process.stdout.readline().strip() == name

    def digest(self, seed):
        if not self._is_there:
            return None
        print(seed, file=self._process.stdin, flush=True)
        return self._process.stdout.readline().strip()


def answer_with_digests():
    print(_core.isa(), flush=True)
    for line in sys.stdin:
        print(cut_digest(int(line)), flush=True)


def camera_of(rng):
    """Return a camera near the origin, with any focal length that a picture can
    have."""
    eye = rng.normal(size=3) * 3
    width = int(rng.integers(1, 40))
    height = int(rng.integers(1, 40))
    fov_x = float(rng.choice((0.1, 0.3, 1.0, 2.5)))
    return v3dg.Camera.look_at(
        eye, eye + rng.normal(size=3), width=width, height=height, fov_x=fov_x
    )


def usual_arrays(rng, count, camera):
    """Return gaussians in front of the camera, as (N, ...) arrays of doubles."""
    to_world = camera.viewmat[:3, :3].T
    slopes = rng.uniform(-0.6, 0.6, (count, 2)) * [
        camera.width / camera.fx,
        camera.height / camera.fy,
    ]
    depths = np.linspace(1.0, 4.0, count)
    rays = np.column_stack([slopes, np.ones(count)]) * depths[:, None]
    size_px = np.exp(rng.uniform(math.log(0.3), math.log(8.0), (count, 1)))
    return {
        "means": rays @ to_world.T + camera.position,
        "quats": rng.normal(size=(count, 4)),
        "scales": size_px * np.exp(rng.uniform(-1, 0, (count, 3))) * depths[:, None] / camera.fx,
        "opacities": rng.uniform(0.02, 1.0, count),
        "sh": rng.normal(size=(count, 4, 3)) * 0.5,
    }


def gaussians_of(arrays):
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        return v3dg.Gaussians(**{name: np.asarray(arrays[name], np.float32) for name in NAMES})


def extreme_fault(seed):
    """Return the fault if a picture of gaussians with extreme values, or its gradients,
    are not finite."""
    rng = np.random.default_rng(seed)
    camera = camera_of(rng)
    arrays = usual_arrays(rng, 50, camera)
    values = EXTREMES + NOT_FINITE if rng.random() < 0.5 else EXTREMES
    changed = rng.choice(NAMES, rng.integers(1, 4), replace=False)
    for name in changed:
        flat = arrays[name].reshape(-1)
        places = rng.random(flat.size) < rng.choice((0.02, 0.3, 1.0))
        signs = 1.0 if name in ("scales", "opacities") else rng.choice((-1.0, 1.0), places.sum())
        flat[places] = rng.choice(values, places.sum()) * signs
    gaussians = gaussians_of(arrays)
    mode = MODES[rng.integers(len(MODES))]
    tensors = {name: torch.tensor(getattr(gaussians, name), requires_grad=True) for name in NAMES}
    image = v3dg.rasterize(v3dg.Gaussians(**tensors), camera, **mode)
    for name in ("color", "alpha", "depth"):
        if not torch.isfinite(getattr(image, name)).all():
            return f"{name}: expected finite pixels, got others in mode {mode}"
    if not ((image.alpha >= 0) & (image.alpha <= 1)).all():
        return "alpha: expected values from 0 to 1, got others"
    if "sh" in changed or "scales" in changed:
        # gradients are proportional to these values, so they may exceed the range of
        # float32
        return None
    (image.color.sum() + image.alpha.sum()).backward()
    for name, tensor in tensors.items():
        if torch.isnan(tensor.grad).any():
            return f"gradient of {name}: expected numbers, got NaN in mode {mode}"
    return None


def reference_fault(seed):
    """Return the fault if a picture of gaussians over many decades differs from the
    float64 reference."""
    rng = np.random.default_rng(seed)
    camera = camera_of(rng)
    arrays = usual_arrays(rng, 30, camera)
    arrays["quats"] *= 10.0 ** rng.uniform(-37, 37, (30, 1))
    size = 10.0 ** rng.uniform(-8, 8)
    arrays["scales"] *= size
    arrays["means"] = (arrays["means"] - camera.position) * size
    viewmat = camera.viewmat.copy()
    viewmat[:3, 3] = 0
    camera = v3dg.Camera(viewmat, camera.K, camera.width, camera.height, 1e-2 * size)
    gaussians = gaussians_of(arrays)
    mode = MODES[rng.integers(1, len(MODES))]
    expected = reference_rasterize.rasterize(gaussians, camera, **mode)
    try:
        assert_pictures_agree(v3dg.rasterize(gaussians, camera, **mode), expected, BOUND)
    except AssertionError as error:
        return f"picture in mode {mode}: {' '.join(str(error).split())[:300]}"
    return None


def cut_digest(seed):
    """Return the digest of a cut of a scene whose poses, tolerance and camera span many
    decades."""
    rng = np.random.default_rng(seed)
    scene = v3dg.Scene()
    size = 10.0 ** rng.uniform(-12, 12)
    count = int(rng.integers(1, 20))
    scene.add(
        random_bundle(int(rng.integers(4)), num_levels=3, max_cluster=9),
        positions=rng.normal(size=(count, 3)) * 5 * size,
        quaternions=rng.normal(size=(count, 4)) * 10.0 ** rng.uniform(-300, 300, (count, 1)),
        scales=size * 10.0 ** rng.uniform(-3, 3, count),
    )
    eye = rng.normal(size=3) * 20 * size
    camera = v3dg.Camera.look_at(eye, (0, 0, 0), width=64, height=48, near=1e-3 * size)
    tolerance = float(rng.choice((0.0, 1e-30, 1.0, 30.0, 1e30)))
    cut = v3dg.select(scene, camera, tolerance=tolerance, device="cpu")
    return hashlib.sha256(cut.instance_ids.tobytes() + cut.cluster_ids.tobytes()).hexdigest()[:16]


if __name__ == "__main__":
    answer_with_digests()
